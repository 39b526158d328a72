"""What changed, where the answer is known: sample flights with a known effect, and real flights of
two Crazyflies.

    python -m experiments.diagnosis.changes --work DIR --seeds 11 12 13 --vehicles E8=FOLDER
    E9=FOLDER=ANSWERS.json

Sample flights of each effect, and of none, are diagnosed with those of none flown with another seed
as the reference. A vehicle is a folder of conditions with `labels.json` (or a file of answers) and
its normal flights in `normal_flight` or `reference`. These two are of CrazyPAD
(github.com/AerialRoboticsUUST/CrazyPAD, commit 5448265, MIT; Masalimov et al., Data 2024, 9(6),
79): no orientation, so trims alone are compared. Every condition is compared with all normal
flights, and each day of normal flights with the others. `--figure` draws the figure of
docs/what_changed.md into `--work` instead.
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments.table import Page, Table, page_parser, publish
from openjax.commands.sample_flights import SampleFlightsCommand, make_case
from openjax.files import read_json
from openjax.flights.case import read_folder
from openjax.flights.csv_table import write_csv
from openjax.flights.manoeuvres import references
from openjax.flights.samples import fly, log_of
from openjax.gap.folders import diagnose_folder
from openjax.gap.report import Report
from openjax.gap.report.trims_page import draw_places, draw_trim
from openjax.gap.trims import Change, change_between, compare, read
from openjax.gap.trims.figures import TRIMS
from openjax.vehicle import load_vehicle

EFFECTS = ("motor_lag", "mass", "rotor_drag", "rate_gains", "none")
NORMAL = ("normal_flight", "reference")


def record_of(vehicle: str, condition: str, truth: dict, answer: Report | Change) -> dict:
    """One comparison: what was done, and what was said by the diagnosis or by trims alone."""
    out = {"vehicle": vehicle, "condition": condition, "truth": truth}
    if isinstance(answer, Report) and not answer.named and answer.change_by_trims is not None:
        answer = answer.change_by_trims
    if isinstance(answer, Report):
        return out | {
            "probability": 1.0 - answer.probabilities.get("none", 0.0),
            "said": list(answer.effects),
            "changed": bool(answer.effects),
            "effects": list(answer.effects),
            "rotors": [],
        }
    size = answer.size
    return out | {
        "probability": answer.probability,
        "size90": [size.value, size.low, size.high],
        "least": answer.least,
        "said": list(answer.likely_causes) if answer.changed else [],
        "changed": answer.changed,
        "effects": list(answer.effects),
        "rotors": list(answer.rotors) if answer.changed else [],
    }


def sample_records(work: Path, seeds: list[int]) -> list[dict]:
    """Sample flights of each effect against normal ones of the next seed."""
    for seed in seeds:
        for effect in EFFECTS:
            folder = work / f"{effect}_{seed}"
            if not folder.exists():
                make_case(SampleFlightsCommand(folder, effect=(effect,), seed=seed))
    out = []
    for effect in EFFECTS:
        for seed, other in zip(seeds, [*seeds[1:], seeds[0]], strict=True):
            answer = diagnose_folder(work / f"{effect}_{seed}", [work / f"none_{other}"])
            out.append(record_of("sample", f"{effect}, seed {seed}", {"cause": effect}, answer))
    return out


def vehicle_records(name: str, folder: Path, labels: dict) -> list[dict]:
    """Each condition against all normal flights, each day of these against the others."""
    (normal,) = [n for n in NORMAL if (folder / n).is_dir()]
    case, old, _ = read(read_folder(folder / normal))
    out = []
    for number, day in enumerate(dict.fromkeys(f.day for f in old), 1):
        new, others = ([f for f in old if (f.day == day) == own] for own in (True, False))
        if others:
            change = change_between(day, new, others, case)
            out.append(record_of(name, f"normal flights, day {number}", {"cause": "none"}, change))
    for condition, truth in labels.items():
        if condition != normal:
            change = change_between(condition, read(read_folder(folder / condition))[1], old, case)
            out.append(record_of(name, condition, truth, change))
    return out


def study(options) -> dict:
    """All comparisons."""
    records = sample_records(options.work, options.seeds) if options.seeds else []
    for entry in options.vehicles:
        name, folder, *answers = entry.split("=")
        labels = read_json(Path(answers[0]) if answers else Path(folder) / "labels.json")
        records += vehicle_records(name, Path(folder), labels)
    return {"records": records}


def cut(record: dict) -> float:
    """Millimetres cut off the propeller that lost most; 0 for anything else."""
    return max(record["truth"].get("mm", {"": 0.0}).values())


def figures_of(records: list[dict]) -> Table:
    """How often the answers are right."""
    samples = [r for r in records if r["vehicle"] == "sample"]
    real = [r for r in records if r["vehicle"] != "sample"]
    rows = []

    def count(what: str, chosen: list[dict], right) -> None:
        rows.append({"what": what, "right": sum(map(right, chosen)), "of": len(chosen)})

    sampled = [r for r in samples if r["truth"]["cause"] != "none"]
    count(
        "sample flights with an effect: it is named first",
        sampled,
        lambda r: r["effects"][:1] == [r["truth"]["cause"]],
    )
    plain = [r for r in samples if r not in sampled]
    count("sample flights without: no change", plain, lambda r: not r["changed"])
    quiet = [r for r in real if r["truth"]["cause"] in ("none", "tape")]
    count(
        "real, normal flights of another day and tape: no change", quiet, lambda r: not r["changed"]
    )
    deep = [r for r in real if cut(r) >= 4]
    count("real, a propeller cut by 4 mm or more: changed", deep, lambda r: r["changed"])
    shallow = [r for r in real if 0 < cut(r) < 4]
    count("real, cut by less: changed", shallow, lambda r: r["changed"])
    count(
        "real, cuts that were found: the rotors are among those named",
        [r for r in real if cut(r) and r["changed"]],
        lambda r: set(r["truth"]["rotors"]) <= set(r["rotors"]),
    )
    return Table({"flights": "what", "right": "right:d", "of": "of:d"}, rows)


def page(results: dict) -> Page:
    """The figures."""
    prose = (
        "Two sets of flights of one vehicle are compared; what was changed is known. The real "
        "flights are open: they were in sight when the priors were settled. The sample flights' "
        "seeds were not. Sizes are of a rotor's thrust, or of what changed."
    )
    return Page("What changed", prose, figures_of(results["records"]))


def figure(folder: Path) -> None:
    """Two normal days, whose rotors differ by 2 % as new propellers do, and one with a weaker
    rotor.
    """
    vehicle = load_vehicle()
    rng = np.random.default_rng(3)
    for seed, (name, weaker) in enumerate(
        {"friday": 0.0, "monday": 0.0, "tuesday": 0.22}.items(), 1
    ):
        (folder / name).mkdir(parents=True)
        factors = 0.02 * rng.standard_normal(4) - weaker * np.array([0.0, 0.0, 1.0, 0.0])
        effects = {
            "motor_imbalance": dict(zip(("m1", "m2", "m3", "m4"), factors.tolist(), strict=True))
        }
        for k, (flight, reference) in enumerate(references(seed=seed, duration=8.0).items()):
            columns = fly(vehicle, vehicle, reference, 10 * seed + k, effects)
            write_csv(folder / name / f"{flight}.csv.gz", log_of(columns, flight))
    change = compare(
        read_folder(folder / "tuesday"), [read_folder(folder / d) for d in ("friday", "monday")]
    )
    _draw(change).savefig(folder / "what_changed.png", dpi=90)


def _draw(change: Change) -> Figure:
    """Trims of every flight, day by day, and where the change would be."""
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    axes = figure.subplots(1, 5, width_ratios=(1, 1, 1, 1, 1.3))
    level = np.mean([f.values["hover"][0] for f in change.reference])
    for axis, name in zip(axes, TRIMS, strict=False):
        draw_trim(axis, change, name, level)
        axis.set(title=name)
    axes[0].set_ylabel("% of hover (band: 90 % of normal days)")
    draw_places(axes[4], change)
    axes[4].set(title="probability")
    return figure


def main() -> None:
    """Compare and report, or draw."""
    parser = page_parser(__doc__, "changes")
    parser.add_argument("--seeds", type=int, nargs="+", default=[])
    parser.add_argument(
        "--vehicles", nargs="+", default=[], help="real flights: NAME=FOLDER[=ANSWERS]"
    )
    parser.add_argument(
        "--work", type=Path, default=Path("runs/changes"), help="folder for sample flights"
    )
    parser.add_argument("--figure", action="store_true")
    options = parser.parse_args()
    figure(options.work) if options.figure else publish(options, study, page)


if __name__ == "__main__":
    main()
