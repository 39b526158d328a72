"""Evaders of a map: scripted ones, and who knows the team. Of these some learn against
the policy, each by one network for all cells, and one plans.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from openjax.commands.exploit_evaders import Findings, compile_learning, learn
from openjax.commands.options import MapCommand
from openjax.errors import UserError
from openjax.evaluation.episodes import make_evaluate
from openjax.evaluation.judges.best_response import BestResponse, Evaders, fly_learners
from openjax.evaluation.judges.duel import Duel
from openjax.evaluation.judges.planner import Planner
from openjax.pursuit import EpisodeStatistics, Pursuit, PursuitSettings, Task
from openjax.store.policies import LoadedPolicy
from openjax.store.policy_files import fill, load_policy_file, save_policy_file


@dataclasses.dataclass(frozen=True)
class EvaderFlights:
    """Evaders of one kind, in whatever cells."""

    name: str
    fly: Callable[[Any, Task, jax.Array], EpisodeStatistics]
    """(networks, tasks (B, ...), key) -> statistics (B, ...)."""
    episodes: int
    """Of each cell."""
    networks: Any
    """The policy's parameters, and those of evaders that learned. They are handed in,
    so that policies of one kind share a compiled program.
    """
    width: int = 1
    """Worlds that an episode needs."""


@dataclasses.dataclass(frozen=True, eq=False)
class MapEvaders:
    """Those of a map's cells, against one policy."""

    command: MapCommand
    game: PursuitSettings
    """Of all cells."""
    loaded: LoadedPolicy
    """The policy in it."""
    draw: Callable[[jax.Array, jax.Array], Task]
    """(key, cell (3,)) -> a task in it."""

    @property
    def duel(self) -> Duel:
        """The game with an evader that is told where to fly; its own rule is the cheapest one."""
        return Duel(Pursuit(dataclasses.replace(self.game, evaders=("field",))), self.loaded.policy)

    @property
    def response(self) -> BestResponse:
        """The learners; they meet whatever lies between the map's cells, too."""
        command = self.command
        sizes = jnp.array(command.sizes, jnp.float32)

        def draw_task(key):
            keys = jax.random.split(key, 4)
            cell = [jax.random.choice(keys[0], sizes)]
            for key, values in zip(keys[1:3], (command.speed_ratios, command.radii), strict=True):
                cell.append(jax.random.uniform(key, (), minval=min(values), maxval=max(values)))
            return self.draw(keys[3], jnp.stack(cell))

        return BestResponse(command.learning, self.duel, draw_task)

    @property
    def scripted(self) -> EvaderFlights:
        """Scripted ones, which know nothing of the team."""
        command = self.command
        evaluate = make_evaluate(Pursuit(self.game), self.loaded.policy, messages=command.messages)

        def fly(parameters, tasks, key):
            return evaluate(parameters, tasks, key).statistics

        return EvaderFlights("scripted evaders", fly, command.episodes, self.loaded.parameters)

    def learn(self, tell: Callable[[str], None]) -> tuple[Evaders, list[dict]]:
        """Learners after their training, and what was told on the way."""
        tell("compiling the evaders' learning ...")
        parameters = self.loaded.parameters
        programs, wait_for_programs = compile_learning(self.response, parameters)
        wait_for_programs()
        findings = Findings(None, tell, {})
        looks = learn(self.command, programs, parameters, findings)
        return looks[max(looks)], findings.values["curve"]

    def learned(self, evaders: Evaders) -> EvaderFlights:
        """Each learner's mean; statistics (B, L)."""
        duel = self.duel
        hold = self.command.learning.hold

        def fly(networks, tasks, key):
            parameters, evaders = networks
            start = duel.start(tasks, key)
            results, _ = fly_learners(duel, hold, evaders, parameters, start)
            return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), results)

        return EvaderFlights(
            "evaders that learned",
            fly,
            self.command.episodes,
            (self.loaded.parameters, evaders),
            width=len(evaders.world_axes),
        )

    @property
    def planned(self) -> EvaderFlights:
        """The planner, in the first of a cell's episodes."""
        command = self.command
        planner = Planner(command.planning, self.duel)

        def fly(parameters, tasks, key):
            return planner.fly(parameters, planner.duel.start(tasks, key), key)

        episodes = min(command.planner_episodes, command.episodes)
        # wider than others, as nothing but the ends of its plans is kept
        width = -(-command.planning.plans // 4)
        return EvaderFlights("an evader that plans", fly, episodes, self.loaded.parameters, width)

    def evaders(self, tell: Callable[[str], None]) -> tuple[Evaders, list[dict]]:
        """Those of the command's file, or new ones, and what was told while they learned."""
        command = self.command
        learners, curve = (
            self.learn(tell) if command.learned is None else self.load(command.learned)
        )
        if command.evaders_out is not None:
            # at once: flying takes minutes, in which anything may happen
            self.save(command.evaders_out, learners, curve)
        return learners, curve

    def save(self, path: Path, evaders: Evaders, curve: list[dict]) -> None:
        """Write those that learned, for `load`."""
        notes = {"policy": self.loaded.source, "scenario": self.command.scenario, "curve": curve}
        content = {"map_evaders": {"actor": evaders.actor, "world_axes": evaders.world_axes}}
        save_policy_file(path, content, {"environment": self.game}, notes, storage="float32")

    def load(self, path: Path) -> tuple[Evaders, list[dict]]:
        """Load what `save` wrote; the evaders can fly, not learn on.

        Raises:
          UserError: no such file, or one of other evaders.
        """
        if not path.is_file():
            raise UserError(
                f"--learned {path}: no such file; openjax map writes one with --evaders_out"
            )
        leaves, _, notes = load_policy_file(path, "file of a map's evaders", "openjax map")
        if "map_evaders/world_axes" not in leaves:
            raise UserError(
                f"--learned {path}: holds no evaders of a map; openjax map writes them "
                "with --evaders_out"
            )
        learners = len(leaves["map_evaders/world_axes"])
        settings = dataclasses.replace(self.command.learning, learners=learners)
        response = dataclasses.replace(self.response, settings=settings)
        # how many learned the file says, whatever the command does
        kinds = jax.eval_shape(response.start, jax.random.key(0)).evaders
        abstract = {"map_evaders": {"actor": kinds.actor, "world_axes": kinds.world_axes}}
        content = fill(abstract, leaves, str(path))["map_evaders"]
        evaders = jax.tree.map(lambda kind: jnp.zeros(kind.shape, kind.dtype), kinds)
        return evaders.replace(**content), notes.get("curve", [])


def least_caught(captures: np.ndarray) -> np.ndarray:
    """(E,) the place of the learner that flies each of a cell's episodes (E, L) that
    end with a capture or not: the one that is caught least in the other half of them,
    as whoever is chosen by the episodes that count looks better than it is.
    """
    even = np.arange(len(captures)) % 2 == 0
    if len(captures) < 2:
        return np.zeros(len(captures), int)
    by_even = np.argmin(captures[even].mean(axis=0))
    by_odd = np.argmin(captures[~even].mean(axis=0))
    return np.where(even, by_odd, by_even)
