"""From flights to a better policy: `openjax adapt FLIGHTS --policy NAME --out DIR`.

Diagnoses the flights, draws vehicles from the intervals of what was found, fine-tunes the policy on them by the gradient
through the simulation, and measures both policies on tasks and vehicles that neither was trained on. Writes DIR/policy.npz,
adapt.json and adapt.html.
"""

import base64
import dataclasses
import io
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import tyro

from openjax.commands.command_line import output_console, parse
from openjax.errors import UserError
from openjax.files import check_output_folder, write_text
from openjax.learning.settings import AdaptSettings
from openjax.ranges import Interval, Seed
from openjax.show.steps import Steps
from openjax.store import DEFAULT_POLICY

PROGRAM = "openjax adapt"
STEPS = {"diagnosing and compiling": 60.0, "fine-tuning": 90.0, "measuring": 10.0}
ON_CPU = {"diagnosing and compiling": 80.0, "fine-tuning": 240.0, "measuring": 25.0}
"""Seconds of each, about, with an accelerator and without."""
FIGURES = ("capture_rate", "capture_step", "collision_rate", "crash_rate", "over_speed_rate")
WHICH = ("nominal", "before", "after")
LOSSES = ("crash_rate", "collision_rate", "capture_step")
"""Figures that a vehicle can make worse, of which adapting is to win back what it can."""
ERRORS = 2.0
"""A loss is one that is larger than so many standard errors of the differences of single episodes."""


@dataclasses.dataclass(frozen=True)
class AdaptCommand:
    """Diagnose flights and fine-tune a policy to the vehicle that flew them."""

    flights: Annotated[Path, tyro.conf.Positional] = Path("flights")
    """Folder of flight logs with a vehicle.toml, or an effects.toml of a diagnosis made before."""
    policy: str = DEFAULT_POLICY
    """A run, a policy file or the name of a policy in the package."""
    out: Path = Path("adapted")
    """Directory for what is found."""
    episodes: Annotated[int | None, Interval("[1, 1000000]")] = None
    """Episodes by which the policies are measured; by default 1024 on an accelerator, 128 on a CPU."""
    seed: Seed = 0
    overwrite: bool = False
    """Replace what --out already holds."""
    training: AdaptSettings = dataclasses.field(default_factory=AdaptSettings)


def main(arguments: Sequence[str]) -> int:
    """The command; returns its exit status. Raises UserError where there are no flights, or none that can be used."""
    command = parse(AdaptCommand, AdaptCommand(), arguments, PROGRAM)
    if not command.flights.exists():
        raise UserError(f"{command.flights}: no such folder of flights, nor effects.toml")
    if command.out.exists() and not command.overwrite:
        raise UserError(f"{command.out} already exists: choose another --out or give --overwrite")
    check_output_folder(command.out, "--out")
    import jax

    console, on_cpu = output_console(), jax.default_backend() == "cpu"
    command = dataclasses.replace(command, episodes=command.episodes or (128 if on_cpu else 1024))
    with Steps(f"adapting {command.policy}", ON_CPU if on_cpu else STEPS, console) as steps:
        results = adapt(command, steps.begin)
    for line in in_words(results):
        console.print(line, soft_wrap=True)
    console.print(f"policy, figures and page are in {command.out}", soft_wrap=True)
    return 0


def adapt(command: AdaptCommand, tell: Callable[[str], None] = lambda step: None) -> dict:
    """Do all of it and write it down; `tell` hears the steps. Raises UserError for flights that can't be diagnosed or an
    unusable policy."""
    started = time.monotonic()
    _check_flights(command.flights)
    diagnosis = _Diagnosis(command)
    begin = iter(STEPS)
    tell(next(begin))
    try:
        import jax

        from openjax.commands.machine import describe_machine
        from openjax.commands.validation import uniform_tasks
        from openjax.learning.adaptation import bounds_of, fine_tune, make_adaptation, starting_parameters
        from openjax.store.policies import load_policy
        from openjax.store.policy_files import save_policy_file
        from openjax.store.settings_files import write_json
        from openjax.vehicle.effects.effects_file import load_effects, load_intervals
        from openjax.vehicle.family import adapted_family

        loaded = load_policy(command.policy)
        adaptation = make_adaptation(loaded.settings, command.training)
        game, key = adaptation.game, jax.random.key(command.seed)
        tasks = uniform_tasks(game, 2 * command.episodes, game.max_pillars)
        chosen_by = jax.tree.map(lambda leaf: leaf[: command.episodes], tasks)
        measured_on = jax.tree.map(lambda leaf: leaf[command.episodes :], tasks)
        parameters = starting_parameters(loaded.parameters, loaded.settings)
        nominal = bounds_of({}, {}, rest=0.0)
        ready = compile_programs(adaptation, parameters, chosen_by, nominal)

        effects = diagnosis()
        names, values = load_effects(effects)
        intervals = load_intervals(effects)
        seconds = {"diagnosis": time.monotonic() - started}
        bounds = bounds_of(values, intervals, airframe=game.airframe)
        ready()
        tell(next(begin))
        seconds["compiled"] = time.monotonic() - started
        score = scores_on(adaptation, parameters, chosen_by, jax.random.fold_in(key, 1), bounds)
        tuned = fine_tune(adaptation, parameters, bounds, command.training, key, score)
        tell(next(begin))
        seconds["fine-tuned"] = time.monotonic() - started
        flown = {
            which: episodes(adaptation.evaluate(p, measured_on, jax.random.fold_in(key, 2), vehicles))
            for which, p, vehicles in (
                ("nominal", parameters, nominal),
                ("before", parameters, bounds),
                ("after", tuned.parameters, bounds),
            )
        }
        seconds["measured"] = time.monotonic() - started
    finally:
        diagnosis.stop()
    family = adapted_family(values, intervals, airframe=game.airframe)
    results = {
        "command": f"{PROGRAM} {command.flights} --policy {command.policy} --out {command.out}",
        "machine": describe_machine(),
        "policy": command.policy,
        "effects": list(names),
        "parameters": [
            {"parameter": name, "value": values.get(effect, {}).get(key), "low": low, "high": high}
            for name, low, high, _, _ in family
            for effect, _, key in [name.partition(".")]
            if effect in values
        ],
        "episodes": command.episodes,
        **{which: {name: float(own[name].mean()) for name in FIGURES} for which, own in flown.items()},
        "won_back": won_back(flown),
        "kept": f"fine-tuned, as it was after step {tuned.update}"
        if tuned.update
        else "the policy as it was",
        "history": tuned.history,
        "looks": tuned.looks,
        "seconds": seconds,
    }
    own = dataclasses.replace(loaded.settings, environment=dataclasses.replace(game, vehicles=family))
    command.out.mkdir(parents=True, exist_ok=True)
    notes = {"adapted_from": command.policy, "effects": values, "machine": results["machine"]}
    save_policy_file(command.out / "policy.npz", tuned.parameters, own, notes, storage="float32")
    write_json(command.out / "adapt.json", results)
    write_text(command.out / "adapt.html", page(results))
    return results


def episodes(evaluation) -> dict:
    """Figures (B,) of single episodes."""
    import numpy as np

    of = evaluation.statistics
    names = {"capture_rate": of.captured, "crash_rate": of.crashed}
    names |= {name: getattr(of, name) for name in ("collision_rate", "over_speed_rate", "capture_step")}
    return {name: np.asarray(value, float) for name, value in names.items()}


def scores_on(adaptation, parameters, tasks, key, bounds, hear=lambda figures: None):
    """Scores (B,) of a policy's episodes on tasks (B, ...), policy -> scores, by which checkpoints are chosen, too.

    Speeds over the limit count as far as they are more than in the same episode of `parameters` with the nominal vehicle:
    to fly as fast with the diagnosed one is what is wanted, and a vehicle that made a policy slower did nothing good by it.
    `hear` is told the mean of each figure, each time.
    """
    import numpy as np

    from openjax.commands.validation import selection_score
    from openjax.learning.adaptation import bounds_of

    usual = episodes(adaptation.evaluate(parameters, tasks, key, bounds_of({}, {}, rest=0.0)))

    def scores(policy):
        found = episodes(adaptation.evaluate(policy, tasks, key, bounds))
        hear({name: float(values.mean()) for name, values in found.items()})
        found["over_speed_rate"] = np.maximum(found["over_speed_rate"], usual["over_speed_rate"])
        return selection_score(found, adaptation.game.episode_length)

    return scores


def won_back(flown: dict) -> dict[str, float | None]:
    """Of each loss, before against nominal, the share that is none any more after; None where there was none beyond chance.

    Args:
      flown: {"nominal", "before", "after": figures (B,) of the same episodes}.
    """
    shares = {}
    for name in LOSSES:
        loss, left = (flown[which][name] - flown["nominal"][name] for which in ("before", "after"))
        seen = loss.mean() > ERRORS * loss.std() / len(loss) ** 0.5
        shares[name] = float(1.0 - left.mean() / loss.mean()) if seen else None
    return shares


def _check_flights(path):
    """What can be wrong with them is told before anything is compiled. Raises UserError."""
    from openjax.flights.case import load_case
    from openjax.vehicle.effects.effects_file import load_effects

    (load_case if path.is_dir() else load_effects)(path)


class _Diagnosis:
    """A diagnosis that runs beside the compiler; called, it waits for the effects file that it writes."""

    def __init__(self, command: AdaptCommand):
        self.out, self.process = command.out / "diagnosis", None
        self.effects = command.flights
        if command.flights.is_dir():
            if self.out.exists():
                shutil.rmtree(self.out)
            self.effects = self.out / command.flights.resolve().name / "effects.toml"
            self.process = subprocess.Popen(
                [sys.executable, "-m", "openjax.diagnose", str(command.flights), "--out", str(self.out)],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                env=os.environ | {"JAX_PLATFORMS": "cpu"},  # the accelerator is the trainer's
            )

    def __call__(self) -> Path:
        if self.process is not None:
            complaint = self.process.communicate()[1].strip()
            if self.process.returncode != 0:
                last = complaint.splitlines()[-1] if complaint else "it ended without a word"
                raise UserError(f"{self.effects.parent.name}: no diagnosis: {last.removeprefix('error: ')}")
        return self.effects

    def stop(self) -> None:
        """End it if it is still running."""
        if self.process is not None and self.process.poll() is None:
            self.process.terminate()
            self.process.wait()


def compile_programs(adaptation, parameters, tasks, bounds):
    """Start to compile flights, update and evaluation; a function that waits for all."""
    import jax

    from openjax.background import compile_ahead

    key = jax.random.key(0)
    flights = jax.eval_shape(adaptation.fly, parameters, key, bounds)
    state = jax.eval_shape(adaptation.optimiser.init, parameters.actor)
    waits = [
        compile_ahead(adaptation.update, parameters.actor, state, parameters, flights, key, bounds),
        compile_ahead(adaptation.evaluate, parameters, tasks, key, bounds),
        compile_ahead(adaptation.fly, parameters, key, bounds),
    ]
    return lambda: [wait() for wait in waits]


def in_words(results: dict) -> list[str]:
    """What was found and gained."""
    effects = ", ".join(results["effects"]) or "no effect: the simulator is right to within the noise"
    changes = "; ".join(
        f"{name.replace('_', ' ')} " + " → ".join(f"{results[which][name]:.4g}" for which in WHICH)
        for name in FIGURES
    )
    shares = {name: share for name, share in results["won_back"].items() if share is not None}
    won = ", ".join(f"{name.replace('_', ' ')} {share:.0%}" for name, share in shares.items())
    return [
        f"Found: {effects}.",
        f"On {results['episodes']} tasks that neither was trained on, with the nominal vehicle → with vehicles drawn from what "
        f"was found, before → after: {changes}.",
        f"Won back of what the vehicle costs: {won}." if won else "The vehicle costs nothing beyond chance.",
        f"Kept: {results['kept']}. {results['seconds']['measured']:.0f} s.",
    ]


def page(results: dict) -> str:
    """One self-contained HTML page."""
    import jinja2

    template = Path(__file__).with_name("adapt.html.jinja").read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    return environment.from_string(template).render(
        results=results, words=in_words(results), figures=FIGURES, which=WHICH, picture=_picture(results)
    )


def _picture(results):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.2), layout="constrained")
    shown = {
        "crashes_from_starts": "crashes from leaning starts (smooth)",
        "crashes_in_flight": "crashes within flights (smooth)",
        "off_the_nominal_flight": "distance from the nominal vehicle's flight",
    }
    for axes, (name, title) in zip(figure.subplots(1, len(shown)), shown.items(), strict=True):
        course = [row[name] for row in results["history"]]
        axes.plot(range(1, len(course) + 1), course)
        axes.set(title=title, xlabel="update", ylim=(0, None))
    FigureCanvasAgg(figure)
    data = io.BytesIO()
    figure.savefig(data, dpi=110)
    return base64.b64encode(data.getvalue()).decode()
