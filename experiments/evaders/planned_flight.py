"""Team plans at flight time, as a layer over a policy that learners fly against:
`python -m experiments.evaders.planned_flight --policy NAME ...`, with the arguments of
`openjax exploit`.

Every 40 ms the team weighs `PLANS` plans of its own against `WAYS` of the evader, all
flown by points (`openjax.learning.team_plans`), and takes the one that is best against
the evader's best answer. A plan says where each pursuer goes; the policy flies there, as
it is shown the evader at that place.
"""

import functools
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from openjax.command_line import run_command
from openjax.commands import exploit, exploit_evaders
from openjax.evaluation.judges.duel import Duel
from openjax.learning.plan_search import best_of
from openjax.learning.team_plans import Points, TeamPlans, no_plan
from openjax.pursuit.axes import turned_back
from openjax.pursuit.task import evader_speed

PLANS = 12
SECONDS = 0.6
RENEW = 40
"""Control steps after which other plans are drawn."""


def ways() -> np.ndarray:
    """(8, 3) to the corners of a cube, where an evader can fly."""
    grid = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3)
    return (grid / 3**0.5).astype(np.float32)


@dataclass(frozen=True)
class StraightPlans(TeamPlans):
    """Team plans whose points fly straight: over half a second pillars are left to the policy."""

    def desired_velocity(self, task, paths, position, target):
        """(N, 3) m/s, straight to (N, 3) targets."""
        way = target - position
        far = jnp.linalg.norm(way, axis=-1, keepdims=True) + 1e-6
        return way / far * jnp.minimum(self.game.max_speed, far / 0.1)

    def payoff(self, task, paths, end: Points):
        """() worth of a pair to the evader."""
        far = jnp.linalg.norm(end.position - end.evader, axis=-1)
        room = (jnp.min(far) + 0.5 * jnp.mean(far)) / (4.0 * self.game.arena_radius)
        return end.free + room + 0.2 * end.breaches


@dataclass(frozen=True, eq=False)
class PlannedDuel(Duel):
    """A duel whose team flies plans."""

    @functools.cached_property
    def plans(self) -> StraightPlans:
        """The search."""
        return StraightPlans(self.environment.settings, PLANS, SECONDS)

    def plan(self, state):
        """The plan of one world that is best against the worst of the evader's ways."""
        plans = self.plans
        key = jax.random.fold_in(jax.random.key(5), state.step // RENEW)
        own = state.replace(evader_position=state.last_seen)
        start = plans.start(own)
        teams = plans.candidates(key, no_plan(len(state.drones.position)))
        speed = evader_speed(plans.game, state.task)
        velocity = jnp.repeat(speed * jnp.asarray(ways())[:, None], plans.steps, 1)

        def pair(team, velocity):
            return plans.payoff(
                state.task, None, plans.fly(state.task, None, start, team, velocity)[0]
            )

        worth = jax.vmap(jax.vmap(pair, (None, 0)), (0, None))(teams, velocity)
        return best_of(teams, -worth)[0]

    def fly(self, parameters, world, velocity, steps):
        """Worlds after control steps, as `Duel.fly`; the team plans once."""
        plan = jax.vmap(self.plan)(world[1])

        def aim(observation, state, plan):
            evader = state.last_seen
            shift = self.plans.target(plan, evader, 0.0) - evader
            shift = jnp.where(state.seen, shift, 0.0)
            own = observation.self_state
            own = own.at[:, :3].add(-turned_back(observation.heading, shift))
            return observation.replace(self_state=own, position=observation.position - shift)

        def act(observation, state):
            aimed = jax.vmap(aim)(observation, state, plan)
            return self.policy.act(parameters, aimed)

        return self.fly_actions(act, world, velocity, steps)


def main(arguments: list[str]) -> int:
    """The command."""
    exploit_evaders.Duel = PlannedDuel
    return exploit.main(arguments)


if __name__ == "__main__":
    run_command(main)
