"""The game and the tasks by which a policy is judged, for programs beside `openjax
exploit`.
"""

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

from openjax.commands.exploit_evaders import record
from openjax.errors import UserError
from openjax.evaluation.evaluator import layout_slots, layout_tasks, stack
from openjax.evaluation.judges.receding_horizon import RecedingHorizon
from openjax.evaluation.judges.tasks import JUDGE_KEY, judging_tasks
from openjax.evaluation.validation import uniform_tasks
from openjax.files import write_json
from openjax.pursuit import SCENARIOS, Pursuit, PursuitSettings, RewardSettings, Task
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
        """Whose game it was: policy, vehicle and effects, as `openjax exploit` stores
        them.
        """
        vehicle = self.options.vehicle or self.environment.settings.airframe
        effects = self.environment.effect_parameters
        return {"policy": self.loaded.source, "vehicle": str(vehicle), "effects": effects}

    def records_kept(self, name: str, fly: Callable, found: dict, path: Path) -> None:
        """Fly one evader, and write its records beside those that are `found`, and its
        seconds, after every part of the tasks; `fly` (parameters, tasks, key) ->
        statistics (B,), traceable.
        """
        self._keep(name, self._flown_in_parts(jax.jit(fly)), found, path)

    def replanned_kept(self, name: str, judge: RecedingHorizon, found: dict, path: Path) -> None:
        """The same of who plans again and again, `--slots` episodes side by side: one
        makes room for the next as soon as its evader is caught, so that no crash after
        that is counted.
        """
        self._keep(name, self._flown_in_slots(judge), found, path)

    def _keep(self, name, all_flown, found, path):
        """Write records of all that has flown, {place: statistics ()}, each time there
        is more.
        """
        began = time.monotonic()
        before = found["records"]
        for flown in all_flown:
            records = self._records_of(name, flown)
            found["records"] = before + records
            found["seconds"][name] = time.monotonic() - began
            write_json(path, found)
            rates = ", ".join(
                f"{one['scenario']} {one['capture_rate']:.2f} of {one['episodes']}"
                for one in records
            )
            print(f"{name}, {found['seconds'][name]:.0f} s: {rates}", flush=True)

    @property
    def _of_kinds(self):
        """Places of all tasks by kinds, and an order in which all kinds come early."""
        of_kinds = self.part(np.arange(len(self.tasks.evader_position)))
        return of_kinds, spread([len(places) for places in of_kinds.values()])

    def _records_of(self, name, flown):
        of_kinds, _ = self._of_kinds
        records = []
        for kind, places in of_kinds.items():
            done = [flown[place] for place in places.tolist() if place in flown]
            if done:
                stack = jax.tree.map(lambda *leaves: np.stack(leaves), *done)
                records.append(record(name, kind, stack))
        return records

    def _flown_in_parts(self, fly):
        _, order = self._of_kinds
        together = min(self.options.together or order.size, order.size)
        flown = {}
        for begin in range(0, order.size, together):
            # the last part is filled up with tasks that have been flown: one program
            # for all
            places = order[min(begin, order.size - together) :][:together]
            key = jax.random.fold_in(jax.random.key(self.options.seed), begin)
            tasks = jax.tree.map(lambda leaf, here=places: leaf[here], self.tasks)
            statistics = jax.tree.map(np.asarray, fly(self.loaded.parameters, tasks, key))
            for i, place in enumerate(places.tolist()):
                flown[place] = jax.tree.map(operator.itemgetter(i), statistics)
            yield flown

    def _flown_in_slots(self, judge):
        _, order = self._of_kinds
        slots = min(self.options.slots, order.size)
        length = self.environment.settings.episode_length
        key = jax.random.key(self.options.seed)
        start = jax.jit(lambda tasks: judge.begin(judge.duel.start(tasks, key)))(self.tasks)
        replan = jax.jit(judge.replan)

        @jax.jit
        def begin(carry, slot, place):
            return jax.tree.map(lambda leaf, new: leaf.at[slot].set(new[place]), carry, start)

        left = order.tolist()
        flies = [left.pop(0) for _ in range(slots)]
        carry = jax.tree.map(lambda leaf: leaf[np.array(flies)], start)
        flown = {}
        while len(flown) < order.size:
            key, own = jax.random.split(key)
            carry = replan(self.loaded.parameters, carry, own)
            state = carry.world[1]
            over = np.asarray(state.statistics.captured | (state.step >= length))
            before = len(flown)
            for slot in np.flatnonzero(over).tolist():
                ended = jax.tree.map(lambda leaf, i=slot: np.asarray(leaf[i]), state.statistics)
                flown.setdefault(flies[slot], ended)
                # with none left, the slot flies on with what it has, and that isn't
                # kept
                if left:
                    flies[slot] = left.pop(0)
                    carry = begin(carry, slot, flies[slot])
            if len(flown) > before:
                yield flown


def spread(sizes: Sequence[int]) -> np.ndarray:
    """Places of things that lie kind after kind, in an order in which each beginning
    has of every kind the share that the whole has.
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
    parser.add_argument("--kinds", nargs="*", help="layouts and uniform; by default all")
    parser.add_argument("--together", type=int, help="tasks that fly side by side; by default all")
    parser.add_argument(
        "--slots", type=int, help="episodes side by side that end with the capture; for a CPU"
    )
    parser.add_argument(
        "--track_unseen",
        action="store_true",
        help="pursuers look for who hides where it can be, whatever they learnt",
    )
    parser.add_argument(
        "--fresh", type=int, help="number from 1 on: other uniform tasks of that key"
    )
    parser.add_argument("--steps", type=int, help="of an episode, to try it")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, required=True)
    return parser


def uniform_of(game: PursuitSettings, options: argparse.Namespace) -> Task:
    """Uniform tasks: those by which policies are judged, and so chosen, or with
    `--fresh` others that are drawn alike.
    """
    if options.fresh is None:
        return judging_tasks(game, options.uniform)
    paper = PursuitSettings()
    drawn = dataclasses.replace(game, min_pillars=paper.min_pillars, max_pillars=paper.max_pillars)
    return uniform_tasks(drawn, options.uniform, game.max_pillars, JUDGE_KEY + options.fresh)


def judged_game(options: argparse.Namespace) -> JudgedGame:
    """As `openjax exploit` has it: one vehicle, honest physics, the reward counts for
    nothing.
    """
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
        track_unseen=options.track_unseen or own.track_unseen,
    )
    environment = make_environment(game, options.vehicle, options.effects)
    kinds = layout_tasks(game, list(SCENARIOS.values()), options.episodes)
    kinds["uniform"] = uniform_of(game, options)
    if options.kinds:
        unknown = [kind for kind in options.kinds if kind not in kinds]
        if unknown:
            raise UserError(f"--kinds {unknown[0]}: these are known: {', '.join(kinds)}")
        kinds = {kind: kinds[kind] for kind in options.kinds}
    return JudgedGame(environment, loaded.in_game(environment), *stack(kinds), options)
