"""What the diagnosis says of folders of published flights whose causes nobody knows in full: names,
sizes, and the response of the torques.

    python -m experiments.diagnosis.real_flights FOLDER ... --separate FOLDER --jobs 2
    --out experiments/results/real/real.json

A folder is one case, or holds several. Of a folder after `--each` each flight is a case of its own.
Of one after `--separate` it is so twice, once with its own rows and once with rows of 100 Hz that
hold the motors' means, as laboratories log them: both are of one vehicle, so that what rows hide
shows as a difference.
"""

import argparse
import json
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np

from experiments.flying.single_thread import share_out, use_single_thread

PERIOD = 0.01  # s
NOMINAL = 0.025  # s, the simulator's motors
SURE = 0.5
BY_HAND = (0.38, 0.41)  # 1/s, of NanoBench's vehicle


def cases_of(folder: Path) -> list[Path]:
    """The cases that a folder is or holds."""
    if (folder / "vehicle.toml").exists():
        return [folder]
    return sorted(path.parent for path in folder.glob("*/vehicle.toml"))


def as_means(case):
    """A case of fast rows with rows of PERIOD: sensors at a row's time, motors as means from there
    to the next.
    """
    flights = []
    for flight in case.flights:
        grid = np.arange(flight.time[0], flight.time[-1] - PERIOD, PERIOD)
        begin = np.searchsorted(flight.time, grid)
        end = np.searchsorted(flight.time, grid + PERIOD)
        # rows are missing now and then
        whole = end - begin > 0.7 * np.median(end - begin)
        begin = begin[whole]
        end = end[whole]
        motor = [flight.motor_command[i:j].mean(0) for i, j in zip(begin, end, strict=True)]
        sensed = {name: getattr(flight, name)[begin] for name in ("body_rates", "specific_force")}
        flights.append(replace(flight, time=grid[whole], motor_command=np.array(motor), **sensed))
    log = case.vehicle_file.log | {"motor_rows": "mean"}
    return replace(case, flights=tuple(flights), vehicle_file=replace(case.vehicle_file, log=log))


Part = tuple[Path, int | None, bool]
"""A diagnosis' folder, the number of its flight or None for all, whether as means."""


def flights_of(folder: Path, rows: tuple[bool, ...]) -> list[Part]:
    """Each flight of a folder by itself, with each kind of rows: as means or not."""
    from openjax.flights.case import load_case

    count = len(load_case(folder).flights)
    return [(folder, n, means) for n in range(count) for means in rows]


def diagnose(part: Part) -> dict:
    """What is kept of one diagnosis."""
    from openjax.flights.case import load_case
    from openjax.gap.diagnosis import diagnose_case
    from openjax.gap.report.rules import broken_rules

    folder, number, means = part
    case = load_case(folder)
    name = f"{folder.parent.name}/{folder.name}"
    if number is not None:
        case = replace(case, flights=(case.flights[number],))
        name = f"{folder.name}/{case.flights[0].name.split('.')[0]}"
    if means:
        case = as_means(case)
        name += ", 100 Hz"
    begin = time.process_time()
    report = diagnose_case(case)
    seconds = time.process_time() - begin
    told = report.to_dict()
    torques = report.identification
    mass = float(case.vehicle_file.vehicle_of(case.flights[0].vehicle).mass)
    out = {"case": name, "mass": mass}
    out["named"] = list(report.effects) or [report.verdict]
    out["probabilities"] = {e: round(p, 3) for e, p in report.probabilities.items() if p > 0.03}
    out["shares"] = told["shares"]["effects"]
    out["parameters"] = {
        effect: {p: [v["value"], *v["interval90"]] for p, v in found.items()}
        for effect, found in told["parameters"].items()
    }
    out["not_testable"] = told["not_testable"]
    out["sensors"] = list(report.sensors)
    out["broken_rules"] = broken_rules(report)
    if torques is not None:
        out["torques"] = {"sentence": torques.sentence(), "trusted": torques.trustworthy} | {
            n: [q.value, *q.interval90] for n, q in torques.quantities.items()
        }
    out["cpu_seconds"] = round(seconds, 1)
    print(json.dumps(out), flush=True)
    return out


def groups_of(names: list[str]) -> dict[str, list[str]]:
    """Names of cases by what they are: folders of one set, or single flights of it."""
    set_of = {n.split("/")[1]: n.split("/")[0] for n in names if "/flight_" not in n}
    groups: dict[str, list[str]] = {}
    for name in names:
        head, _, tail = name.partition("/")
        if "/flight_" in name:
            head = f"{set_of.get(head, head)}, single flights"
            head += ", 100 Hz" * tail.endswith("100 Hz")
        groups.setdefault(head, []).append(name)
    return groups


def figures(found: list[dict]) -> dict:
    """How often each name stands somewhere, first, and with a probability of .5, by groups of
    cases; and in how many motors are clearly slower than NOMINAL.
    """
    by_name = {case["case"]: case for case in found}

    def slow(case: dict) -> bool:
        torques = case.get("torques", {"trusted": False})
        return torques["trusted"] and torques["spin_up"][1] > NOMINAL

    out = {}
    for group, names in groups_of(list(by_name)).items():
        cases = [by_name[name] for name in names]
        likely = Counter(
            e for c in cases for e in c["named"] if c["probabilities"].get(e, 0) >= SURE
        )
        out[group] = {
            "cases": len(cases),
            "named": dict(Counter(e for c in cases for e in c["named"])),
            "first": dict(Counter(c["named"][0] for c in cases)),
            "named_at_half": dict(likely),
            "motors_shown_slow": sum(map(slow, cases)),
            "broken_rules": sum(bool(c.get("broken_rules")) for c in cases),
        }
    return out


def draw(cases: list[dict], path: Path) -> None:
    """Drag over mass of each case that names it, with its 90 % interval; hollow where another name
    stands first.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    named = [c for c in cases if "rotor_drag" in c["parameters"]]
    figure, axes = plt.subplots(figsize=(7.0, 4.6), layout="constrained")
    axes.axvspan(*BY_HAND, color="0.88", label="NanoBench by hand")
    for place, case in enumerate(reversed(named)):
        value, low, high = (v / case["mass"] for v in case["parameters"]["rotor_drag"]["d_xy"])
        first = case["named"][0] == "rotor_drag"
        axes.plot([low, high], [place, place], color="C0", lw=1.5)
        axes.plot(value, place, "o", color="C0", mfc="C0" if first else "white")
    names = [c["case"] for c in reversed(named)]
    axes.set_yticks(range(len(named)), names, fontsize=7)
    axes.set_xlabel("drag in the rotor plane over mass, 1/s")
    axes.set_xlim(0.0, None)
    axes.legend(loc="lower left", fontsize=8)
    figure.savefig(path, dpi=110)


def rounded(value, digits: int = 4):
    """Numbers of a nested structure with so many significant digits."""
    if isinstance(value, dict):
        return {k: rounded(v, digits) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(v, digits) for v in value]
    return float(f"{value:.{digits}g}") if isinstance(value, float) else value


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folders", type=Path, nargs="*")
    parser.add_argument("--each", type=Path, nargs="*", default=[])
    parser.add_argument("--separate", type=Path, nargs="*", default=[])
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("real.json"))
    parser.add_argument("--figure", type=Path, help="drawn from --out, if it's there")
    arguments = parser.parse_args()
    if arguments.figure:
        found = json.loads(arguments.out.read_text(encoding="utf-8"))
        draw(found["cases"], arguments.figure)
        return
    use_single_thread()
    from openjax.files import write_text
    from openjax.runs.machine import describe_machine

    parts = [(c, None, False) for f in arguments.folders for c in cases_of(f)]
    for folders, rows in ((arguments.each, (False,)), (arguments.separate, (False, True))):
        parts += [p for f in folders for c in cases_of(f) for p in flights_of(c, rows)]
    command = "python -m experiments.diagnosis.real_flights"
    command += "".join(f" {f.name}" for f in arguments.folders)
    command += "".join(f" --each {f.name}" for f in arguments.each)
    command += "".join(f" --separate {f.name}" for f in arguments.separate)
    head = {"command": command, "machine": describe_machine()}
    found: list[dict] = []
    # after each case, so that what was found is there if the rest is cut short
    for case in share_out(diagnose, [(part,) for part in parts], arguments.jobs):
        found = sorted([*found, case], key=lambda c: c["case"])
        figured = {"of": len(parts), "figures": figures(found), "cases": rounded(found)}
        write_text(arguments.out, json.dumps(head | figured, indent=1) + "\n")


if __name__ == "__main__":
    main()
