"""The game and the tasks by which a policy is judged, for programs beside `openjax exploit`."""

import argparse
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from openjax.errors import UserError
from openjax.evaluation.evaluator import layout_slots, layout_tasks, stack
from openjax.evaluation.judges.tasks import judging_tasks
from openjax.pursuit import SCENARIOS, Pursuit, RewardSettings, Task
from openjax.pursuit.settings import LAYOUT_PURSUERS
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


def game_parser(doc: str | None, episodes: int, uniform: int) -> argparse.ArgumentParser:
    """The options of `judged_game`."""
    parser = argparse.ArgumentParser(description=doc)
    parser.add_argument("--policy", default="evaders")
    parser.add_argument("--vehicle", type=Path, help="vehicle.toml; by default the nominal one")
    parser.add_argument("--effects", type=Path, help="effects.toml")
    parser.add_argument("--episodes", type=int, default=episodes, help="of each layout")
    parser.add_argument("--uniform", type=int, default=uniform, help="uniform tasks")
    parser.add_argument("--kinds", nargs="*", help="layouts and uniform; by default all")
    parser.add_argument("--steps", type=int, help="of an episode, to try it")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, required=True)
    return parser


def judged_game(options: argparse.Namespace) -> JudgedGame:
    """As `openjax exploit` has it: one vehicle, honest physics, the reward counts for nothing."""
    cache_programs()
    loaded = load_policy(options.policy).of_team(LAYOUT_PURSUERS)
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
    if options.kinds:
        unknown = [kind for kind in options.kinds if kind not in kinds]
        if unknown:
            raise UserError(f"--kinds {unknown[0]}: these are known: {', '.join(kinds)}")
        kinds = {kind: kinds[kind] for kind in options.kinds}
    return JudgedGame(environment, loaded.in_game(environment), *stack(kinds), options)
