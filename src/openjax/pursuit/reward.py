"""The reward: terms with weights, those of the paper's section IV-A and what was added
to them.

A term of one's own is a function of a `Transition`; `Pursuit(settings, reward=(...))`
takes it.
"""

import dataclasses
import functools
import operator
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from openjax.errors import UserError, part_name, suggestion
from openjax.pursuit.axes import rotation_axes
from openjax.pursuit.collisions import breaches, crashed
from openjax.pursuit.info import StepInfo
from openjax.pursuit.settings import PursuitSettings, RewardSettings
from openjax.pursuit.shapes import Active, Each, Flag, Pillars, Scalar, Team, Vector, Which
from openjax.pursuit.shortest_paths import path_length
from openjax.pursuit.state import PursuitState
from openjax.pursuit.teams import of_team
from openjax.vehicle.vectors import length

OVER_SPEED = 1.01
"""Share of the maximal speed above which a step counts as over speed."""


FREE = 1.0
"""Seconds for which an evader has to be free before another capture of it counts: to
let go of it for as long costs more than a capture pays, at the default weights and a
`recapture` below 600.
"""


def captures(
    settings: PursuitSettings,
    position: Team,
    evader: Vector,
    in_sight: Which,
    radius: float | Scalar | None = None,
) -> Which:
    """(N,) whether each pursuer has the evader within the capture radius, with a clear
    line of sight; `radius` () m goes before the settings' one.
    """
    radius = settings.capture_radius if radius is None else radius
    return in_sight & (jnp.sum((position - evader) ** 2, axis=-1) < radius**2)


def over_speed(settings: PursuitSettings, velocity: Team) -> Which:
    """(N,) whether each pursuer of (N, 3) velocities is faster than 1.01 times the
    maximal speed.
    """
    return jnp.sum(velocity**2, axis=-1) > (OVER_SPEED * settings.max_speed) ** 2


@struct.dataclass
class Transition:
    """One control step of N pursuers, as reward terms see it."""

    settings: PursuitSettings = struct.field(pytree_node=False)
    before: PursuitState
    state: PursuitState
    """After the step."""
    info: StepInfo
    """The events in it; its `penalty` isn't known yet."""

    @property
    def pillars(self) -> tuple[Pillars, Active]:
        """(P, 2) m, axes of the pillars; (P,) bool, which slots are in use."""
        return self.state.task.pillar_position, self.state.task.pillar_active


@dataclass(frozen=True)
class Term:
    """A part of the reward: what it counts, times its weight."""

    function: Callable[[Transition], jax.Array]
    """(N,), of each pursuer, or (), of all."""
    weight: float
    penalty: bool = False
    """A training may let penalties grow (`mappo.penalty_start`); never positive."""


def check_terms(terms: Any) -> tuple[Term, ...]:
    """Terms that somebody hands in, as a tuple. Raises UserError for anything else."""
    if not isinstance(terms, tuple | list):
        raise UserError(
            f"reward: {part_name(terms)} is no tuple; (Term(function, weight), ...) would be right"
        )
    for term in terms:
        if not isinstance(term, Term):
            raise UserError(
                f"reward: {part_name(term)} is no Term; Term(function, weight) would be right"
            )
    return tuple(terms)


def _weigh(term, transition):
    """A term's part of the reward. Raises UserError where its function asks for a field
    that isn't there, or gives another shape than () or (N,).
    """
    try:
        value = term.function(transition)
    except AttributeError as error:
        if not dataclasses.is_dataclass(error.obj):
            raise
        fields = [field.name for field in dataclasses.fields(error.obj)]
        raise UserError(
            f"reward term {part_name(term.function)}: {type(error.obj).__name__} has no "
            f"{error.name}; {suggestion(error.name, fields)}"
        ) from None
    number = transition.settings.num_pursuers
    if getattr(value, "shape", ()) not in ((), (number,)):
        raise UserError(
            f"reward term {part_name(term.function)} gives shape {value.shape}; () of all "
            f"pursuers or ({number},) of each would be right"
        )
    return term.weight * value


def total_reward(terms: tuple[Term, ...], transition: Transition) -> tuple[Each, Each]:
    """(N,) reward of each pursuer, the sum of the terms in their order, penalties last;
    and (N,) the sum of its penalties. Empty slots have none.
    """
    # penalties apart, as a training may let them grow; always in one order, which
    # rounds alike
    nothing = jnp.zeros(transition.settings.num_pursuers, jnp.float32)

    def total(is_penalty):
        values = [_weigh(term, transition) for term in terms if term.penalty == is_penalty]
        return functools.reduce(operator.add, values) if values else nothing

    penalty = jnp.broadcast_to(total(True), nothing.shape)
    reward = jnp.broadcast_to(total(False) + penalty, nothing.shape)
    return of_team(transition.state.active, (reward, penalty))


def default_reward(weights: RewardSettings) -> tuple[Term, ...]:
    """The game's own terms, those that have a weight.

    A capture by any rewards all; distance to the evader, breaches, speed, crashes and
    the change of the squashed command count for each.
    """
    # the order stays: sums of floats depend on it, and first updates are compared to
    # the bit
    terms = (
        Term(captured, weights.CAPTURE),
        Term(evader_distance, -weights.distance),
        Term(evader_path, -weights.path),
        Term(unseen, -weights.unseen),
        Term(first_capture, weights.first_capture),
        Term(recapture, weights.recapture),
        Term(steadiness, weights.smoothness),
        Term(breach_number, -weights.collision, penalty=True),
        Term(speeding, -weights.OVER_SPEED, penalty=True),
        Term(crashing, -weights.crash, penalty=True),
        Term(first_crash, -weights.first_crash, penalty=True),
    )
    return tuple(term for term in terms if term.weight != 0.0)


def captured(transition: Transition) -> Flag:
    """() whether any pursuer has the evader."""
    return jnp.any(transition.info.captured)


def first_capture(transition: Transition) -> Flag:
    """() whether this is the first such step of the episode."""
    return captured(transition) & ~transition.before.statistics.captured


def evader_distance(transition: Transition) -> Each:
    """(N,) m to the evader."""
    offset = transition.state.drones.position - transition.state.evader_position
    return length(offset)


def evader_path(transition: Transition) -> Each:
    """(N,) m, the shortest path round the pillars to the evader."""
    state = transition.state
    position = state.drones.position
    return path_length(
        transition.settings, state.task, state.paths, position, state.evader_position
    )


def unseen(transition: Transition) -> Flag:
    """() whether nobody sees the evader."""
    return ~transition.info.seen


def recapture(transition: Transition) -> Flag:
    """() whether this is a later capture, of an evader that was free for `FREE`
    seconds.
    """
    statistics = transition.before.statistics
    was_free = statistics.free_steps * transition.settings.time_step >= FREE
    return captured(transition) & statistics.captured & was_free


def steadiness(transition: Transition) -> Each:
    """(N,) from one, where the squashed command stays, to zero."""
    change = transition.state.previous_action - transition.before.previous_action
    # a length that has a gradient where nothing changes, too
    return jnp.exp(-length(change))


def breach_number(transition: Transition) -> Each:
    """(N,) breaches of safety distances and bounds, early by the reward's margin and
    lookahead.
    """
    settings = transition.settings
    weights = settings.reward
    drones = transition.state.drones
    pillars, pillar_active = transition.pillars
    breach = transition.info.breaches
    if weights.margin != 0.0:
        breach = breaches(settings, drones.position, pillars, pillar_active, weights.margin)
    if weights.lookahead != 0.0:
        ahead = drones.position + weights.lookahead * drones.velocity
        breach_ahead = breaches(settings, ahead, pillars, pillar_active)
        # the greater, not the sum: one that is near and comes nearer counts once
        breach = jax.tree.map(jnp.maximum, breach, breach_ahead)
    return breach.total


def speeding(transition: Transition) -> Which:
    """(N,) whether each is above 1.01 times the maximal speed."""
    return transition.info.over_speed


def crashing(transition: Transition) -> Which:
    """(N,) whether each touches something or tips over, early by the reward's margin
    and lookahead.
    """
    settings = transition.settings
    weights = settings.reward
    drones = transition.state.drones
    body_z_up = rotation_axes(drones.quaternion)[1][:, 2]
    pillars, pillar_active = transition.pillars
    crash = transition.info.crashed
    if weights.margin != 0.0:
        crash = crashed(
            settings, drones.position, body_z_up, pillars, pillar_active, weights.margin
        )
    if weights.lookahead != 0.0:
        ahead = drones.position + weights.lookahead * drones.velocity
        crash = crash | crashed(settings, ahead, body_z_up, pillars, pillar_active)
    return crash


def first_crash(transition: Transition) -> Which:
    """(N,) whether each crashes now, in an episode without a crash before; never
    early.
    """
    return transition.info.crashed & ~transition.before.statistics.crashed
