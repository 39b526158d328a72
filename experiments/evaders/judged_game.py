"""The game and the tasks by which a policy is judged, for programs beside `openjax exploit`."""

import argparse
import dataclasses
import operator
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from openjax.evaluation.evaluator import layout_slots, layout_tasks, stacked
from openjax.evaluation.judges.tasks import judging_tasks
from openjax.files import write_json
from openjax.pursuit import SCENARIOS, Pursuit, RewardSettings, Task
from openjax.runs.exploit import record
from openjax.store.compiled_programs import cache_programs
from openjax.store.environments import make_environment
from openjax.store.policies import LoadedPolicy, load_policy


@dataclass(frozen=True)
class JudgedGame:
    """A policy in its game, on the judge's tasks."""

    environment: Pursuit
    loaded: LoadedPolicy
    tasks: Task  # (B, ...), of all kinds
    part: Callable[[Any], dict[str, Any]]
    """(B, ...) to the same by kinds"""
    options: argparse.Namespace

    @property
    def flown(self) -> dict:
        """Whose game it was: policy, vehicle and effects, as `openjax exploit` stores them."""
        vehicle = self.options.vehicle or self.environment.settings.airframe
        effects = self.environment.effect_parameters
        return {"policy": self.loaded.source, "vehicle": str(vehicle), "effects": effects}

    def records_kept(self, name: str, fly: Callable, found: dict, path: Path) -> None:
        """Fly one evader, and write its records beside those that are `found`, and its seconds,
        after every part of the tasks; `fly` (parameters, tasks, key) -> statistics (B,), traceable.
        """
        began = time.monotonic()
        before = found["records"]
        for records in self._records_in_parts(name, jax.jit(fly)):
            found["records"] = before + records
            found["seconds"][name] = time.monotonic() - began
            write_json(path, found)
            rates = ", ".join(f"{one['scenario']} {one['capture_rate']:.2f}" for one in records)
            print(f"{name}, {found['seconds'][name]:.0f} s: {rates}", flush=True)

    def _records_in_parts(self, name, fly):
        """Records of all that has flown, after every part."""
        number = len(self.tasks.evader_position)
        of_kinds = self.part(np.arange(number))
        order = spread([len(places) for places in of_kinds.values()])
        together = min(self.options.together or number, number)
        flown = {}
        for begin in range(0, number, together):
            # the last part is filled up with tasks that have been flown: one program for all
            places = order[min(begin, number - together) :][:together].tolist()
            key = jax.random.fold_in(jax.random.key(self.options.seed), begin)
            tasks = jax.tree.map(lambda leaf, here=tuple(places): leaf[np.array(here)], self.tasks)
            statistics = jax.tree.map(np.asarray, fly(self.loaded.parameters, tasks, key))
            for i, place in enumerate(places):
                flown[place] = jax.tree.map(operator.itemgetter(i), statistics)
            yield [
                record(name, kind, jax.tree.map(lambda *leaves: np.stack(leaves), *done))
                for kind, here in of_kinds.items()
                if (done := [flown[place] for place in here.tolist() if place in flown])
            ]


def spread(sizes: Sequence[int]) -> np.ndarray:
    """Places of things that lie kind after kind, in an order in which each beginning has of every
    kind the share that the whole has.
    """
    share = np.concatenate([(np.arange(size) + 0.5) / size for size in sizes])
    return np.argsort(share, kind="stable")


def game_parser(doc: str | None, episodes: int, uniform: int) -> argparse.ArgumentParser:
    """The options of `judged_game`."""
    parser = argparse.ArgumentParser(description=doc)
    parser.add_argument("--policy", default="evaders")
    parser.add_argument("--vehicle", type=Path, help="vehicle.toml; by default the nominal one")
    parser.add_argument("--effects", type=Path, help="effects.toml")
    parser.add_argument("--episodes", type=int, default=episodes, help="of each layout")
    parser.add_argument("--uniform", type=int, default=uniform, help="uniform tasks")
    parser.add_argument("--together", type=int, help="tasks that fly side by side; by default all")
    parser.add_argument("--steps", type=int, help="of an episode, to try it")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, required=True)
    return parser


def judged_game(options: argparse.Namespace) -> JudgedGame:
    """As `openjax exploit` has it: one vehicle, honest physics, the reward counts for nothing."""
    cache_programs()
    loaded = load_policy(options.policy)
    own = loaded.settings.environment
    game = dataclasses.replace(
        own,
        vehicles=(),
        rare_vehicles=0.0,
        max_pillars=layout_slots(own),
        evaders=("field",),
        reward=RewardSettings(),
        episode_length=options.steps or own.episode_length,
    )
    environment = make_environment(game, options.vehicle, options.effects)
    kinds = layout_tasks(game, list(SCENARIOS.values()), options.episodes)
    kinds["uniform"] = judging_tasks(game, options.uniform)
    return JudgedGame(environment, loaded.in_game(environment), *stacked(kinds), options)
