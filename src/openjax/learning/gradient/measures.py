"""Smooth measures of a flight: how near a crash, a breach or the evader is.

A crash or a capture is a step, which has no gradient. Here each goes from none to whole
over a distance, so that the actor feels it before it comes.
"""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from openjax.learning.settings import AnalyticSettings
from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import Observation, Pursuit, PursuitSettings, PursuitState, RewardSettings
from openjax.pursuit.axes import rotation_axes
from openjax.pursuit.collisions import TOUCH, drone_distance, pillar_distance
from openjax.pursuit.sensing import sight_room
from openjax.pursuit.settings import LAYOUT_PURSUERS
from openjax.pursuit.shortest_paths import ShortestPaths, path_length, shortest_paths
from openjax.pursuit.task import arena_of, capture_radius
from openjax.vehicle import DroneState
from openjax.vehicle.solids import DRONE_RADIUS
from openjax.vehicle.vectors import length

Worlds = Float[Array, "worlds"]
"""A number of each world."""
Pursuers = Float[Array, "worlds pursuers"]
"""A number of each pursuer of each world."""

SMOOTH = 0.012
"""Distance (m) over which a crash goes from sure to none in what is learnt: gaps
between pillars of a row aren't wide. First flights feel it from farther
(`crash_smooth`).
"""
SMOOTH_BREACH = 0.008
"""The same for a breach of a safety distance or a bound (m)."""
SMOOTH_TILT = 0.05
"""The same for a tip over 90 degrees (cosine of the tilt)."""
SMOOTH_CAPTURE = 0.1
"""The same for a capture (m)."""
SMOOTH_NEAREST = 0.15
"""The same for which pursuer is nearest to the evader (m)."""
SMOOTH_SIGHT = 0.05
"""The same for whether a line of sight passes a pillar (m)."""
FAST = 0.05
"""Speed (m/s) above where the speed begins to cost that costs as much as a crash in
every step would.
"""
REST = 0.9
"""Share of the capture radius within which a pursuer needn't come nearer to the
evader.
"""
LOWEST = 0.35
"""The end of a start costs below this height (m) ..."""
FASTEST = 1.0
"""... and above this speed (m/s): a dive saves some starts, and must end."""


def team_weight(game: PursuitSettings, weight: float) -> float:
    """`weight` of what each of three pursuers does wrong, for a larger team.

    It is a mean over the team's slots, and whether the evader is free isn't: unless each
    cost 8/3 as much among eight, they pressed on past every bound (breaches of .001 became
    .022). The weights were tuned to two digits.
    """
    return float(f"{weight * max(1.0, game.num_pursuers / LAYOUT_PURSUERS):.2g}")


def nearest_gap(game: PursuitSettings, state: PursuitState) -> Pursuers:
    """(W, N) m, from each pursuer of worlds (W, ...) to the nearest solid thing:
    pillar, pursuer or floor.
    """
    position = state.drones.position
    task = state.task
    to_pillar = jax.vmap(lambda p, q: pillar_distance(game, p, q))(position, task.pillar_position)
    active = task.pillar_active[:, None]
    gap = jnp.min(to_pillar, axis=-1, where=active, initial=jnp.inf) - DRONE_RADIUS
    if game.num_pursuers > 1:
        others = jnp.min(jax.vmap(drone_distance)(position), axis=-1)
        gap = jnp.minimum(gap, others - 2 * DRONE_RADIUS)
    return jnp.minimum(gap, position[..., 2] - DRONE_RADIUS)


def crash_share(gap: Float[Array, "*worlds"], smooth: float = SMOOTH) -> Float[Array, "*worlds"]:
    """The share of a crash that a least gap (m) counts as, from 1 to 0 over `smooth` (m). It has a
    gradient before a touch.
    """
    # half of one at three times the gap that counts as a touch
    return jax.nn.sigmoid((3 * TOUCH - gap) / smooth)


def crash_depth(gap: Float[Array, "*worlds"]) -> Float[Array, "*worlds"]:
    """The same that goes on to grow, by 1 every `SMOOTH`: what would crash by far is
    learnt from, too.
    """
    return jax.nn.softplus((3 * TOUCH - gap) / SMOOTH)


def tip_share(upright: Float[Array, "*worlds"]) -> Float[Array, "*worlds"]:
    """The same of a least cosine of the tilt."""
    return jax.nn.sigmoid((2 * SMOOTH_TILT - upright) / SMOOTH_TILT)


def breach_share(game: PursuitSettings, state: PursuitState) -> Pursuers:
    """(W, N) smooth number of breaches of each pursuer in worlds (W, ...);
    `openjax.pursuit.collisions.breaches`.
    """
    position = state.drones.position
    task = state.task
    to_pillar = jax.vmap(lambda p, q: pillar_distance(game, p, q))(position, task.pillar_position)
    to_pillar = jnp.where(task.pillar_active[:, None], to_pillar, jnp.inf) - game.pillar_clearance
    to_drone = jax.vmap(drone_distance)(position) - game.drone_clearance
    radius = arena_of(game, task).arena_radius
    to_wall = jnp.expand_dims(radius, -1) - length(position[..., :2])
    to_ceiling = game.arena_height - position[..., 2]

    def near(distance):
        return jax.nn.sigmoid((SMOOTH_BREACH - distance) / SMOOTH_BREACH)

    total = jnp.sum(near(to_pillar), axis=-1) + jnp.sum(near(to_drone), axis=-1)
    total = total + near(to_wall) + near(to_ceiling)
    return total if state.active is None else jnp.where(state.active, total, 0.0)


def evader_distance(game: PursuitSettings, state: PursuitState, paths: ShortestPaths) -> Pursuers:
    """(W, N) m, shortest paths from pursuers of worlds (W, ...) to the evader, whose
    flight has no gradient: its answers are a cliff.
    """
    evader = jax.lax.stop_gradient(state.evader_position)
    return jax.vmap(functools.partial(path_length, game))(
        state.task, paths, state.drones.position, evader
    )


def hidden_share(game: PursuitSettings, state: PursuitState) -> Worlds:
    """(W,) how well pillars hide the evader of worlds (W, ...) from all pursuers, from
    0 to 1; its flight has no gradient.
    """

    def one(state):
        task = state.task
        target = jax.lax.stop_gradient(state.evader_position)
        room = sight_room(
            game, state.drones.position, target, task.pillar_position, task.pillar_active
        )
        if state.active is not None:
            # who is parked sees it past all pillars
            room = jnp.where(state.active, room, -jnp.inf)
        return jax.nn.sigmoid(-jnp.max(room) / SMOOTH_SIGHT)

    return jax.vmap(one)(state)


def nearest_distance(distance: Pursuers) -> Worlds:
    """(W,) m, a smooth least of distances (W, N): where one pursuer is near, others
    needn't be, and may go round.
    """
    # less the logarithm of their number: of equal distances it is that distance
    number = distance.shape[-1]
    soft = jax.nn.logsumexp(-distance / SMOOTH_NEAREST, axis=-1) - jnp.log(number)
    return -SMOOTH_NEAREST * soft


def free_share(radius: float | jax.Array, distance: Pursuers) -> Worlds:
    """(W,) how free the evader at distances (W, N) is, from 0 to 1: smooth, and felt
    from afar; capture radius () or (W,) m.
    """
    # half free a little inside the capture radius, so that pursuers come in all the way
    return jax.nn.sigmoid((jnp.min(distance, axis=-1) - 0.95 * radius) / SMOOTH_CAPTURE)


def speed(drones: DroneState) -> Pursuers:
    """(W, N) m/s."""
    # the small number keeps the root's gradient finite at rest
    return jnp.sqrt(jnp.sum(drones.velocity**2, axis=-1) + 1e-9)


def end_excess(drones: DroneState) -> Pursuers:
    """(W, N) how much too low (m) and too fast (m/s) the end of a start is."""
    fast = speed(drones) - FASTEST
    low = LOWEST - drones.position[..., 2]
    return jax.nn.relu(fast) + jax.nn.relu(low)


class Encounter(NamedTuple):
    """Measures of what the pursuers of B worlds met in some steps, all smooth and (B, N) unless
    said otherwise.
    """

    least: jax.Array
    """m, least gap to anything solid"""
    upright: jax.Array
    """least cosine of the tilt"""
    breach: jax.Array
    """mean number of breaches"""
    excess: jax.Array
    """mean excess of speed, in units of `FAST`"""
    distance: jax.Array
    """(B,) m, mean length of the nearest pursuers' paths to the evader, beyond where
    they may rest
    """
    free: jax.Array
    """(B,) share of the steps in which nobody has caught the evader"""
    unseen: jax.Array
    """(B,) mean of how well the evader hides from all pursuers"""


def no_encounter(shape: tuple[int, int]) -> Encounter:
    """The contacts of pursuers (B, N) before the first step."""
    zeros = jnp.zeros(shape)
    of_worlds = jnp.zeros(shape[0])
    return Encounter(
        least=zeros + jnp.inf,
        upright=zeros + 1.0,
        breach=zeros,
        excess=zeros,
        distance=of_worlds,
        free=of_worlds,
        unseen=of_worlds,
    )


def mean_step(
    environment: Pursuit, policy: Policy, parameters: PolicyParameters
) -> Callable[..., tuple[Observation, PursuitState]]:
    """A control step of worlds (W, ...) by the policy's mean: (actor, observation,
    state, velocity) -> observation, state; the predictor of `parameters` has no gradient.

    `velocity` (W, 3) is where the evaders fly, as a share of their speed; None or NaN:
    their own rule.
    """
    step = jax.vmap(environment.step, in_axes=(None, 0, 0, 0))

    def fly_on(actor, observation, state, velocity=None):
        prediction = jax.lax.stop_gradient(policy.predict(parameters, observation))
        mean, _ = policy.distribution(actor, observation, prediction)
        # no key: the game draws nothing after its reset
        observation, state, *_ = step(None, state, policy.action(mean, observation), velocity)
        return observation, state

    return fly_on


@dataclass(frozen=True)
class SmoothFlight:
    """The flight of a policy while a gradient is taken. `World`s are observations and states (B,
    ...).
    """

    environment: Pursuit
    """See `free_flight`."""
    policy: Policy

    @property
    def game(self) -> PursuitSettings:
        """The environment's settings."""
        return self.environment.settings

    def change(self, actor: Any, parameters: PolicyParameters, observation) -> Pursuers:
        """(W, N) squared change of what the actor does, in standard deviations of the
        policy of `parameters`.
        """
        prediction = jax.lax.stop_gradient(self.policy.predict(parameters, observation))
        mean_before, log_std = self.policy.distribution(parameters.actor, observation, prediction)
        mean, _ = self.policy.distribution(actor, observation, prediction)
        change = (mean - mean_before) * jnp.exp(-log_std)
        return jnp.sum(change**2, axis=-1)

    def fly(
        self,
        actor: Any,
        parameters: PolicyParameters,
        world,
        steps: int,
        velocity: Float[Array, "worlds 3"] | None = None,
    ) -> tuple[Any, Encounter]:
        """Worlds some steps later, and what their pursuers met in these; `velocity` is
        where the evaders fly, see `mean_step`.
        """
        fly_on = mean_step(self.environment, self.policy, parameters)

        def move(world):
            observation, state = world
            return fly_on(actor, observation, state, velocity)

        return self._follow(move, world, steps, lambda state: None)[0]

    def fly_and_keep(
        self,
        actor: Any,
        parameters: PolicyParameters,
        world,
        steps: int,
        keep: Callable[[PursuitState], Any],
    ) -> tuple[tuple[Any, Encounter], Any]:
        """The same where evaders fly by their own rule; and what `keep` says of the
        states after each step (T, ...).
        """
        fly_on = mean_step(self.environment, self.policy, parameters)

        def move(world):
            observation, state = world
            return fly_on(actor, observation, state)

        return self._follow(move, world, steps, keep)

    def _follow(self, move, world, steps, keep):
        """Worlds some steps later and what their pursuers met; what is kept."""
        # found once: pillars stand still
        paths = jax.vmap(functools.partial(shortest_paths, self.game))(world[1].task)
        # only the worlds between steps are kept, the rest is worked out again on the
        # way back: it would take many times the memory
        move = jax.checkpoint(move)

        def one(carry, _):
            world = move(carry[0])
            encounter = self._measure(carry[1], world[1], paths, steps)
            return (world, encounter), keep(world[1])

        nothing = no_encounter(world[1].drones.position.shape[:2])
        return jax.lax.scan(one, (world, nothing), None, length=steps)

    def _measure(self, encounter, state, paths, steps):
        """Add what the step that ended with `state` brought to what pursuers have met so far."""
        limit = AnalyticSettings.SPEED_FROM * self.game.max_speed
        radius = capture_radius(self.game, state.task)
        rest = REST * radius
        if jnp.ndim(rest):  # of each world, beside its pursuers' distances
            rest = rest[:, None]
        distance = evader_distance(self.game, state, paths)
        beyond_rest = jax.nn.relu(distance - rest)
        return Encounter(
            least=jnp.minimum(encounter.least, nearest_gap(self.game, state)),
            upright=jnp.minimum(
                encounter.upright, rotation_axes(state.drones.quaternion)[1][..., 2]
            ),
            breach=encounter.breach + breach_share(self.game, state) / steps,
            excess=encounter.excess + jax.nn.relu(speed(state.drones) - limit) / FAST / steps,
            distance=encounter.distance + nearest_distance(beyond_rest) / steps,
            free=encounter.free + free_share(radius, distance) / steps,
            unseen=encounter.unseen + hidden_share(self.game, state) / steps,
        )


def free_flight(environment: Pursuit) -> Pursuit:
    """`environment` as it is learnt in: nothing is solid while the gradient is taken, a
    crash is told by the gap.
    """
    free = dataclasses.replace(
        environment.settings, physics="rigid", contacts=False, reward=RewardSettings()
    )
    by_default = {"vehicle_bounds": None, "evader_share": None, "dynamics": None}
    return dataclasses.replace(environment, settings=free, **by_default)
