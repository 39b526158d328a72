"""How far does the gap shrink in the task? What training in the corrected simulator wins back of
what training in the true one would, and what a wrong name wins or costs.

    python -m experiments.diagnosis.adapting diagnose --work DIR --jobs 16
    python -m experiments.diagnosis.adapting tune --work DIR --part 0 2 --out part_0.json   (a GPU)
    python -m experiments.diagnosis.adapting report part_0.json part_1.json --out adapting.json

A vehicle is openjax' own with one effect of 1.5 times its sample strength. `diagnose` flies it
through six segments in uneven air, with sensors of a laboratory, and diagnoses these flights twice:
as they are, and with a library that lacks the cause and what would do as well by the first report,
so that only a wrong name can be given. `tune` flies a policy with the true vehicle and with the
nominal one. Where the vehicle costs something beyond chance it is fine-tuned as `openjax adapt`
does, to the true effect, to what was found, and to the wrong name; all of them fly the same tasks
with the true one.
"""

import argparse
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from experiments.diagnosis.closed_loop import described, fly_segments
from experiments.diagnosis.generate import in_processes
from experiments.flying.single_thread import use_single_thread

# What a policy can lose by; of the others the game of `flight` feels little.
CAUSES = (
    *("motor_lag", "command_latency", "wind", "packet_loss", "com_offset", "rate_gains"),
    *("mass", "state_latency", "rotor_drag", "inertia", "motor_imbalance", "thrust_saturation"),
    *("thrust_scale", "blade_flapping"),
)
STRENGTH = 1.5  # of the effect's sample strength
SEGMENTS = ("hover", "agile", "yaw", "fast", "climb", "low")
SEED = 31
LOSSES = ("crash_rate", "collision_rate", "capture_step")
ERRORS = 2.0  # standard errors beyond which a vehicle costs something
TUNED = ("true", "found", "wrong")


@dataclass(frozen=True)
class Flown:
    """A vehicle and its number, which seeds its flights."""

    number: int

    @property
    def cause(self) -> str:
        return CAUSES[self.number]

    def effects(self) -> dict[str, dict[str, float]]:
        """{cause: {parameter: value}} of the true vehicle."""
        from openjax.vehicle.effects import EFFECTS

        effect = EFFECTS[self.cause]
        none = effect.none()
        strong = {k: none[k] + STRENGTH * (v - none[k]) for k, v in effect.card.sample.items()}
        return {self.cause: none | strong}

    def case(self):
        """Its flights, as a case for the diagnosis."""
        from openjax.flights import flight

        told = replace(described(), mass_weighed=self.cause != "mass")
        names = {name: name for name in SEGMENTS}
        flights = fly_segments(told, names, 1000 * SEED + 100 * self.number, self.effects())
        return flight.Case(self.cause, tuple(flights), told)


def diagnosed(job: tuple[int, Path]) -> dict:
    """Diagnose a vehicle's flights twice and write down what a simulator would be told."""
    from openjax.gap.diagnosis import diagnose_case
    from openjax.gap.report.writing import to_fly
    from openjax.vehicle.effects import save_effects

    number, work = job
    vehicle = Flown(number)
    folder = work / vehicle.cause
    folder.mkdir(parents=True, exist_ok=True)
    case = vehicle.case()
    save_effects(folder / "true.toml", vehicle.effects())
    found = diagnose_case(case)
    without = {vehicle.cause, *found.equivalent.get(vehicle.cause, ())}
    wrong = diagnose_case(case, without=without)
    kept = {"cause": vehicle.cause, "without": sorted(without)}
    for name, report in (("found", found), ("wrong", wrong)):
        # the torques' response corrects a lag or an inertia whatever the library lacks:
        # a wrong answer holds nothing of the right one
        gone = without if name == "wrong" else set()
        told = [{e: v for e, v in d.items() if e not in gone} for d in to_fly(report)]
        values, intervals = told
        save_effects(folder / f"{name}.toml", values, intervals)
        likely = {e: round(p, 3) for e, p in report.probabilities.items() if p > 0.03}
        kept[name] = {"named": list(report.effects), "probabilities": likely}
    (folder / "said.json").write_text(json.dumps(kept) + "\n", encoding="utf-8")
    return kept


class Tuner:
    """A policy with its programs, compiled once for all vehicles."""

    def __init__(self, policy: str, episodes: int, updates: int, seed: int):
        import jax

        from openjax.commands.adapt_policy import compile_programs
        from openjax.evaluation.validation import uniform_tasks
        from openjax.learning.gradient.adaptation import (
            bounds_of,
            make_adaptation,
            starting_parameters,
        )
        from openjax.learning.settings import AdaptSettings
        from openjax.store.policies import load_policy

        loaded = load_policy(policy)
        settings = AdaptSettings(updates=updates, look_every=max(updates // 3, 1))
        self.adaptation = make_adaptation(loaded.settings, settings)
        game = self.adaptation.game
        tasks = uniform_tasks(game, 3 * episodes, game.max_pillars)
        # a third to choose an update by, one to choose vehicles that lose, one to
        # measure by: what was best on tasks is so in part by luck
        self.tasks = [
            jax.tree.map(lambda leaf, i=i: leaf[i * episodes : (i + 1) * episodes], tasks)
            for i in range(3)
        ]
        self.key = jax.random.key(seed)
        self.before = starting_parameters(loaded.parameters, loaded.settings)
        self.nominal = bounds_of({}, {}, rest=0.0)
        self.evaluate, self.learn, ready = compile_programs(
            self.adaptation, self.before, self.tasks[0], self.nominal
        )
        ready()

    def fly(self, parameters, bounds, part: int) -> dict[str, np.ndarray]:
        """Figures (B,) of a part's episodes; the same part draws the same ones."""
        import jax

        from openjax.evaluation.evaluator import episode_figures

        key = jax.random.fold_in(self.key, part)
        flown = self.evaluate(parameters, self.tasks[part], key, bounds)
        return episode_figures(flown.statistics)

    def tuned(self, bounds):
        """The policy fine-tuned to vehicles of the bounds, as `openjax adapt` does."""
        from openjax.commands.adapt_policy import look_of
        from openjax.learning.gradient.adaptation import fine_tune

        usual = self.fly(self.before, self.nominal, 0)
        steps = self.adaptation.game.episode_length

        def look(parameters):
            return look_of(self.fly(parameters, bounds, 0), usual, steps)

        updates = self.learn(self.before, self.key, bounds)
        return fine_tune(updates, self.adaptation.settings, self.before, look)


def bounds_in(folder: Path, name: str):
    """(R, 4) bounds of an effects file; the true vehicle's hold it alone."""
    from openjax.learning.gradient.adaptation import bounds_of
    from openjax.vehicle.effects.effects_file import load_effects, load_intervals

    _, values = load_effects(folder / f"{name}.toml")
    if name != "true":
        return bounds_of(values, load_intervals(folder / f"{name}.toml"))
    exact = {e: {k: (v, v) for k, v in own.items()} for e, own in values.items()}
    return bounds_of(values, exact, rest=0.0)


def losing(nominal: dict, before: dict) -> list[str]:
    """The losses that a vehicle has beyond chance, by the same episodes with the nominal one."""
    found = []
    for name in LOSSES:
        loss = np.asarray(before[name], float) - np.asarray(nominal[name], float)
        if loss.mean() > ERRORS * loss.std() / len(loss) ** 0.5:
            found.append(name)
    return found


def adapted(tuner: Tuner, folder: Path) -> dict:
    """What a vehicle costs, and what is won back of it by each training."""
    said = json.loads((folder / "said.json").read_text(encoding="utf-8"))
    true = bounds_in(folder, "true")
    chosen_by = [tuner.fly(tuner.before, bounds, 1) for bounds in (tuner.nominal, true)]
    out = said | {"loses": losing(*chosen_by)}
    flown = {
        "nominal": tuner.fly(tuner.before, tuner.nominal, 2),
        "before": tuner.fly(tuner.before, true, 2),
    }
    out |= {"kept": {}, "looks": {}}
    for name in TUNED if out["loses"] else ():
        tuned = tuner.tuned(bounds_in(folder, name))
        out["kept"][name] = tuned.update
        out["looks"][name] = tuned.looks
        flown[name] = tuner.fly(tuned.parameters, true, 2)
    out["means"] = {w: {n: float(np.mean(f[n])) for n in LOSSES} for w, f in flown.items()}
    if out["loses"]:
        out["won"] = {n: won(flown, n) for n in LOSSES}
    return out


def won(flown: dict, name: str) -> dict:
    """Mean and covariance of the mean of what each training wins by the same episodes, true, found,
    wrong.
    """
    gains = np.array([flown["before"][name] - flown[w][name] for w in TUNED], float)
    return {"mean": gains.mean(1).tolist(), "cov": (np.cov(gains) / gains.shape[1]).tolist()}


def shares(vehicles: list[dict], name: str) -> dict:
    """Of what true training wins over all vehicles that lose by a figure, the share that the found
    and the wrong name win, with a 90 % interval by the delta method.
    """
    rows = [v["won"][name] for v in vehicles if name in v["loses"]]
    if not rows:
        return {"vehicles": 0}
    mean = np.sum([r["mean"] for r in rows], 0)
    cov = np.sum([r["cov"] for r in rows], 0)
    out = {"vehicles": len(rows), "true_wins": float(mean[0]) / len(rows)}
    if mean[0] <= 0.0:  # there is nothing that could be won back
        return out
    for place, which in ((1, "found"), (2, "wrong")):
        share = mean[place] / mean[0]
        slope = np.zeros(3)
        slope[[place, 0]] = (1.0 / mean[0], -share / mean[0])
        reach = 1.645 * float(np.sqrt(slope @ cov @ slope))
        out[which] = [float(share), float(share) - reach, float(share) + reach]
    return out


def report(vehicles: list[dict]) -> dict:
    """The figures of all vehicles; those whose cause was found first stand by themselves."""
    losers = [v for v in vehicles if v["loses"]]
    right = [v for v in losers if (v["found"]["named"] or [""])[0] == v["cause"]]
    return {
        "vehicles": len(vehicles),
        "named_first": sum((v["found"]["named"] or [""])[0] == v["cause"] for v in vehicles),
        "lose": [v["cause"] for v in losers],
        "shares": {name: shares(losers, name) for name in LOSSES},
        "shares_where_named_first": {name: shares(right, name) for name in LOSSES},
    }


def tune(options) -> None:
    """Fine-tune and fly part of the vehicles; each is written as soon as it is there."""
    from openjax.runs.machine import describe_machine
    from openjax.store.compiled_programs import cache_programs

    cache_programs()
    begin = time.monotonic()
    part, parts = options.part
    tuner = Tuner(options.policy, options.episodes, options.updates, options.seed)
    found = {
        "policy": options.policy,
        "episodes": options.episodes,
        "updates": options.updates,
        "seed": options.seed,
        "machine": describe_machine(),
        "vehicles": [],
    }
    for cause in options.causes[part::parts]:
        said = options.work / cause / "said.json"
        # `diagnose` may still be under way beside this
        while not said.exists() and time.monotonic() - begin < options.wait:
            time.sleep(1.0)
        if not said.exists():
            continue
        if time.monotonic() - begin > options.seconds:
            print("time is up before", cause, flush=True)
            break
        found["vehicles"].append(adapted(tuner, said.parent))
        found["seconds"] = round(time.monotonic() - begin, 1)
        print(json.dumps(found["vehicles"][-1]), flush=True)
        options.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    first = commands.add_parser("diagnose")
    first.add_argument("--jobs", type=int, default=1)
    second = commands.add_parser("tune")
    second.add_argument("--part", type=int, nargs=2, default=(0, 1), metavar=("NUMBER", "OF"))
    second.add_argument("--policy", default="flight")
    second.add_argument("--episodes", type=int, default=2048)
    second.add_argument("--updates", type=int, default=120)
    second.add_argument("--seed", type=int, default=0)
    second.add_argument("--seconds", type=float, default=480.0)
    second.add_argument(
        "--wait", type=float, default=0.0, help="s for diagnoses that aren't there yet"
    )
    for one in (first, second):
        one.add_argument("--work", type=Path, required=True)
        one.add_argument("--causes", nargs="+", choices=CAUSES, default=CAUSES)
    third = commands.add_parser("report")
    third.add_argument("parts", type=Path, nargs="+")
    for one in (second, third):
        one.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    if options.command == "diagnose":
        use_single_thread()
        jobs = [(CAUSES.index(cause), options.work) for cause in options.causes]
        for said in in_processes(diagnosed, jobs, options.jobs):
            print(json.dumps(said), flush=True)
    elif options.command == "tune":
        tune(options)
    else:
        parts = [json.loads(path.read_text(encoding="utf-8")) for path in options.parts]
        vehicles = [v for part in parts for v in part["vehicles"]]
        head = {k: v for k, v in parts[0].items() if k not in ("vehicles", "seconds")}
        found = head | {"figures": report(vehicles), "vehicles": vehicles}
        options.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        print(json.dumps(found["figures"], indent=1))


if __name__ == "__main__":
    main()
