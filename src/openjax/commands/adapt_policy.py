"""The work of `openjax adapt`: a diagnosis beside the compiler, vehicles drawn from it,
fine-tuning, figures of both policies.
"""

import contextlib
import dataclasses
import functools
import itertools
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from openjax.background import compile_ahead
from openjax.baselines import Heuristic
from openjax.commands.adapt_report import FIGURES, WHICH, page
from openjax.commands.options import AdaptCommand
from openjax.errors import UserError
from openjax.evaluation.episodes import make_evaluate_vehicles
from openjax.evaluation.evaluator import episode_figures
from openjax.evaluation.validation import selection_score, uniform_tasks
from openjax.files import write_json, write_text
from openjax.flights.case import load_case
from openjax.interruption import clean_up
from openjax.learning.gradient.adaptation import (
    Look,
    bounds_of,
    fine_tune,
    make_adaptation,
    starting_parameters,
)
from openjax.learning.gradient.stage import GradientStage, compile_stage
from openjax.pursuit import Pursuit
from openjax.runs.machine import describe_machine
from openjax.store.policies import load_policy
from openjax.store.policy_files import save_policy_file
from openjax.vehicle.effects.effects_file import load_effects, load_intervals
from openjax.vehicle.family import adapted_family

STEPS = {"diagnosing and compiling": 60.0, "fine-tuning": 90.0, "measuring": 10.0}
"""Seconds of each step, about, with an accelerator ..."""
ON_CPU = {"diagnosing and compiling": 80.0, "fine-tuning": 240.0, "measuring": 25.0}
"""... and without."""
LOSSES = ("crash_rate", "collision_rate", "capture_step")
"""Figures that a vehicle can make worse, of which adapting is to win back what it can."""
ERRORS = 2.0
"""A loss is one that is larger than so many standard errors of the differences of
single episodes.
"""


def check(command: AdaptCommand) -> None:
    """Raise UserError for anything wrong with flights and policy, before anything is compiled."""
    if isinstance(load_policy(command.policy).policy, Heuristic):
        raise UserError(f"--policy {command.policy}: a heuristic has no networks that could learn")
    (load_case if command.flights.is_dir() else load_effects)(command.flights)


def adapt(
    command: AdaptCommand, tell: Callable[[str, str], None] = lambda step, note: None
) -> dict:
    """Do all of it and write it down; `tell` is told each step, and how far it is. Raises
    UserError for flights that can't be diagnosed or an unusable policy.
    """
    start = time.monotonic()
    seconds = {}
    steps = iter(STEPS)
    tell(next(steps), "")
    with _diagnosis(command) as effects:
        programs = _Programs(command)  # compiles meanwhile
        vehicle = _diagnose(effects(), programs.game.airframe)
        seconds["diagnosis"] = time.monotonic() - start
        tell("diagnosing and compiling", f"found: {', '.join(sorted(vehicle.values)) or 'nothing'}")
    programs.ready()
    seconds["compiled"] = time.monotonic() - start
    step = next(steps)
    tell(step, "")
    tuning = programs.fine_tune(vehicle, functools.partial(tell, step))
    seconds["fine-tuned"] = time.monotonic() - start
    tell(next(steps), "")
    rates = programs.measure(vehicle, tuning.parameters)
    seconds["measured"] = time.monotonic() - start
    results = {**_results(command, vehicle, rates, tuning), "seconds": seconds}
    _write(command, programs, vehicle, tuning, results)
    return results


class _Diagnosed(NamedTuple):
    """The diagnosis of a vehicle."""

    values: dict[str, dict[str, float]]
    family: tuple  # of `VehicleRange`, what vehicles are drawn from
    bounds: jax.Array  # (R, 4) of it


def _diagnose(effects: Path, airframe: str) -> _Diagnosed:
    """The content of an effects file."""
    _, values = load_effects(effects)
    intervals = load_intervals(effects)
    family = adapted_family(values, intervals, airframe=airframe)
    return _Diagnosed(values, family, bounds_of(values, intervals, airframe=airframe))


def look_of(
    episodes: dict[str, np.ndarray], usual: dict[str, np.ndarray], episode_length: int
) -> Look:
    """The function by which `fine_tune` scores a policy's figures (B,), by `selection_score`.

    Speeds over the limit count as far as they are more than in the same `usual` episode, that of
    the policy as it was with the nominal vehicle: to fly as fast with the diagnosed one is what is
    wanted, and a vehicle that made a policy slower did nothing good by it.
    """
    over_speed_rate = np.maximum(episodes["over_speed_rate"], usual["over_speed_rate"])
    figures = episodes | {"over_speed_rate": over_speed_rate}
    return Look(selection_score(figures, episode_length), figures["capture_step"])


class _Programs:
    """A policy, and the compiled programs that fine-tune and measure it."""

    def __init__(self, command: AdaptCommand):
        self.loaded = load_policy(command.policy)
        self.adaptation = make_adaptation(self.loaded.settings, command.training)
        self.game = self.adaptation.game
        self._key = jax.random.key(command.seed)
        # half to choose a checkpoint by, half to measure it on: the chosen one is best
        # on the first half in part by luck
        tasks = uniform_tasks(self.game, 2 * command.episodes, self.game.max_pillars)
        self._chosen_by = jax.tree.map(lambda leaf: leaf[: command.episodes], tasks)
        self._measured_on = jax.tree.map(lambda leaf: leaf[command.episodes :], tasks)
        self._parameters = starting_parameters(self.loaded.parameters, self.loaded.settings)
        self._nominal = bounds_of({}, {}, rest=0.0)
        self._evaluate, self._learn, self.ready = compile_programs(
            self.adaptation, self._parameters, self._chosen_by, self._nominal
        )

    def _fly(self, parameters, tasks, number, bounds) -> dict:
        """Figures (B,) of a policy's episodes; the same `number` draws the same ones."""
        key = jax.random.fold_in(self._key, number)
        return episode_figures(self._evaluate(parameters, tasks, key, bounds).statistics)

    def fine_tune(self, vehicle: _Diagnosed, tell: Callable[[str], None]):
        """The best of the policy's updates (see
        `openjax.learning.gradient.adaptation.fine_tune`); `tell` is told of each look at it.
        """
        # the same draws for all that is compared, here and in each look
        usual = self._fly(self._parameters, self._chosen_by, 1, self._nominal)

        settings = self.adaptation.settings
        looks = itertools.count()

        def look(policy):
            update = min(next(looks) * settings.look_every, settings.updates)
            tell(f"{update} of {settings.updates} updates")
            episodes = self._fly(policy, self._chosen_by, 1, vehicle.bounds)
            return look_of(episodes, usual, self.game.episode_length)

        updates = self._learn(self._parameters, self._key, vehicle.bounds)
        return fine_tune(updates, self.adaptation.settings, self._parameters, look)

    def measure(self, vehicle: _Diagnosed, tuned_parameters) -> dict[str, dict]:
        """Figures (B,) of `WHICH` on tasks that no checkpoint was chosen by."""
        cases = (
            (self._parameters, self._nominal),
            (self._parameters, vehicle.bounds),
            (tuned_parameters, vehicle.bounds),
        )
        return {
            which: self._fly(parameters, self._measured_on, 2, bounds)
            for which, (parameters, bounds) in zip(WHICH, cases, strict=True)
        }


def _results(command, vehicle, rates, tuning) -> dict:
    """The content of adapt.json, without the time that it took."""
    parameters = []
    for name, low, high, *_ in vehicle.family:
        effect, _, key = name.partition(".")
        if effect in vehicle.values:
            value = vehicle.values[effect].get(key)
            parameters.append({"parameter": name, "value": value, "low": low, "high": high})
    return {
        "command": f"openjax adapt {command.flights} --policy {command.policy} --out {command.out}",
        "machine": describe_machine(),
        "policy": command.policy,
        "effects": sorted(vehicle.values),
        "parameters": parameters,
        "episodes": command.episodes,
        **{
            which: {name: float(figures[name].mean()) for name in FIGURES}
            for which, figures in rates.items()
        },
        "won_back": won_back(rates),
        "kept": f"the fine-tuned policy of step {tuning.update}"
        if tuning.update
        else "the policy as it was before",
        "history": tuning.history,
        "looks": tuning.looks,
    }


def _write(command, programs, vehicle, tuning, results):
    """The policy, the figures and the page."""
    game = dataclasses.replace(programs.game, vehicles=vehicle.family)
    settings = dataclasses.replace(programs.loaded.settings, environment=game)
    command.out.mkdir(parents=True, exist_ok=True)
    notes = {
        "adapted_from": command.policy,
        "effects": vehicle.values,
        "machine": results["machine"],
    }
    save_policy_file(
        command.out / "policy.npz", tuning.parameters, settings, notes, storage="float32"
    )
    write_json(command.out / "adapt.json", results)
    write_text(command.out / "adapt.html", page(results))


def won_back(rates: dict) -> dict[str, float | None]:
    """For each loss (before against nominal), the share that is won back after; None if there was
    none beyond chance.

    Args:
      rates: {"nominal", "before", "after": figures (B,) of the same episodes}.
    """
    shares = {}
    for name in LOSSES:
        # of the same episodes: by their differences chance is much smaller
        loss = rates["before"][name] - rates["nominal"][name]
        loss_left = rates["after"][name] - rates["nominal"][name]
        beyond_chance = loss.mean() > ERRORS * loss.std() / len(loss) ** 0.5
        shares[name] = float(1.0 - loss_left.mean() / loss.mean()) if beyond_chance else None
    return shares


@contextlib.contextmanager
def _diagnosis(command: AdaptCommand) -> Iterator[Callable[[], Path]]:
    """A diagnosis that runs beside the compiler; what is given waits for the effects
    file that it writes.
    """
    if not command.flights.is_dir():
        yield lambda: command.flights
        return
    out = command.out / "diagnosis"
    name = command.flights.resolve().name
    # a process of its own: within one, the diagnosis and the tracing of programs would take turns
    shutil.rmtree(out, ignore_errors=True)
    process = subprocess.Popen(
        [sys.executable, "-m", "openjax.diagnose", str(command.flights), "--out", str(out)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"JAX_PLATFORMS": "cpu"},  # the accelerator is the trainer's
    )

    def effects():
        complaint = process.communicate()[1].strip()
        if process.returncode != 0:
            last = complaint.splitlines()[-1] if complaint else "it gave no reason"
            raise UserError(f"{name}: no diagnosis: {last.removeprefix('error: ')}")
        return out / name / "effects.toml"

    try:
        with clean_up(process.terminate):
            yield effects
    finally:
        process.terminate()
        process.wait()


def compile_programs(adaptation, parameters, tasks, bounds):
    """Start to compile the evaluation (parameters, tasks, key, bounds) and the stage
    (parameters, key, bounds); both, and a function that waits for them.
    """
    evaluate = jax.jit(make_evaluate_vehicles(Pursuit(adaptation.game), adaptation.policy))
    # the stage first: its update takes longest
    learn = compile_stage(GradientStage(adaptation), parameters, bounds)
    wait = compile_ahead(evaluate, parameters, tasks, jax.random.key(0), bounds)
    return evaluate, learn, lambda: (learn.ready(), wait())
