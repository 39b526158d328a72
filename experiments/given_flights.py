"""Pages of flights that don't belong to this project: the forty of a second plant, and NanoBench's real ones.

    python -m experiments.given_flights second_plant DIAGNOSES --answers ANSWERS.json    # experiments/results/second_plant.*
    python -m experiments.given_flights nanobench DIAGNOSES                              # experiments/results/real/

DIAGNOSES is what `python -m openjax.diagnose CASE ... --no-html --out DIAGNOSES` or `experiments.diagnosis.diagnose` wrote. Both
sets are for development; what the pages say in words stands in NAME_reading.md beside them.
"""

import argparse
import json
import os
from pathlib import Path

from experiments.changes import commit

RESULTS = Path(__file__).parent / "results"
ASSUMED_MASS = 0.027  # kg, of NanoBench's vehicle file: nobody weighed it, so drag over mass is what is known


def reports(folder):
    """{case: report}."""
    return {p.parent.name: json.loads(p.read_text()) for p in sorted(Path(folder).glob("*/report.json"))}


def names(report):
    """Effects named, without "unknown"."""
    return [e for e in report["effects"] if e not in ("unknown", "none")]


def judge(answer, report):
    """(right, extra names) of one case by its answer: first name of a single cause, all of a pair, none of none."""
    said, fine = names(report), set(answer.get("also_fine", ()))
    if "blade_flapping" in answer["effects"]:
        fine.add("rotor_drag")
    groups = [set(answer["acceptable"].get(e, [e])) for e in answer["effects"]]
    right = set().union(*groups) if groups else set()
    extra = [e for e in said if e not in right and e not in fine]
    if answer["category"] == "single":
        first = next((e for e in said if e in right or e not in fine), None)
        return first in right, extra
    if answer["category"] == "pair":
        return all(any(e in g for e in said) for g in groups) and not extra, extra
    if answer["category"] == "unknown":
        return "unknown" in report["effects"], extra
    return not report["effects"], extra


def second_plant(found, answers):
    """Lines of the page, and what is kept of each case."""
    kept, rows, missed = {}, {}, []
    for name, answer in sorted(answers.items()):
        report = found[name]
        right, extra = judge(answer, report)
        rows.setdefault(answer["category"], []).append((right, bool(extra), "unknown" in report["effects"]))
        if not right or extra:
            said = "+".join(report["effects"]) or report["verdict"]
            missed.append(f"* {answer['category']}: {'+'.join(answer['effects']) or 'none'} → {said}")
        kept[name] = {
            "truth": answer["effects"],
            "category": answer["category"],
            "verdict": report["verdict"],
            "effects": report["effects"],
            "shares": {e: s["value"] for e, s in report["shares"]["effects"].items()},
            "unexplained": report["shares"]["unexplained"]["value"],
            "gap": [report["gap"]["before"], report["gap"]["after"]],
            "probability": max(report["probabilities"].values()),
            "not_testable": report["not_testable"],
        }

    def count(category, number=0):
        own = rows.get(category, [])
        return f"{sum(r[number] for r in own)}/{len(own)}"

    lines = [
        "| | right |",
        "|---|---|",
        f"| single: first name | {count('single')} |",
        f"| single: extra names; false unknown | {count('single', 1)}; {count('single', 2)} |",
        f"| none: nothing named | {count('none')} |",
        f"| not testable: nothing named | {count('not_testable')} |",
        f"| pair exact | {count('pair')} |",
        f"| unknown recall; wrong name | {count('unknown')}; {count('unknown', 1)} |",
        "",
        "Misses:",
        "",
        *missed,
    ]
    return lines, kept


def nanobench(found):
    """Likewise for NanoBench."""
    lines = [
        "| case | named | share of lateral drag [90 %] | d/m, 1/s (27 g) | sensors and clocks | unexplained |",
        "|---|---|---|---|---|---|",
    ]
    kept = {}
    for name, report in found.items():
        shares = report["shares"]
        drag = shares["effects"].get("rotor_drag")
        size = report["parameters"].get("rotor_drag", {}).get("d_xy")
        value = "–" if drag is None else "{:.2f} [{:.2f}, {:.2f}]".format(drag["value"], *drag["interval90"])
        ratio = (
            "–"
            if size is None
            else "{:.3f} [{:.3f}, {:.3f}]".format(
                *(x / ASSUMED_MASS for x in (size["value"], *size["interval90"]))
            )
        )
        lines.append(
            f"| {name} | {', '.join(report['effects']) or report['verdict']} | {value} | {ratio} | "
            f"{shares['sensors']['value']:.2f} | {shares['unexplained']['value']:.2f} |"
        )
        keys = ("effects", "shares", "parameters", "gap", "not_testable", "rest", "sensors")
        kept[name] = {k: report[k] for k in keys if k in report}
    return lines, kept


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("which", choices=("second_plant", "nanobench"))
    parser.add_argument("diagnoses", type=Path)
    parser.add_argument("--answers", type=Path, help="of the second plant")
    parser.add_argument("--commit", help="said on the page where git isn't there")
    parser.add_argument("--machine", default=f"{os.cpu_count()} cores")
    parser.add_argument("--out", type=Path, help="folder of the pages")
    options = parser.parse_args()
    found = reports(options.diagnoses)
    made = f"`python -m openjax.diagnose CASE ... --no-html --out OUT` at {options.commit or commit()}, {options.machine}."
    if options.which == "second_plant":
        if options.answers is None:
            parser.error("--answers: the second plant needs its answers")
        title = "# Forty flights of a second plant"
        about = "A plant that shares no code with openjax; opened, and so a **development** set: not figures to report."
        lines, kept = second_plant(found, json.loads(options.answers.read_text())["cases"])
        path = (options.out or RESULTS) / "second_plant"
        page = path.with_suffix(".md")
    else:
        title = "# Real flights, diagnosed by shares"
        about = (
            "NanoBench (S. I. Ullah, J. Baca, arXiv:2603.09908): a Crazyflie with motion capture, PWM, no commands. The "
            "causes of these flights are not known; what is known by hand is a linear lateral drag, d/m = .38 to .41 1/s."
        )
        lines, kept = nanobench(found)
        path = (options.out or RESULTS / "real") / "nanobench"
        page = path.with_name("README.md")
    reading = path.with_name(path.name + "_reading.md")
    words = ["", reading.read_text().strip()] if reading.exists() else []
    path.with_suffix(".json").write_text(json.dumps(kept, indent=1) + "\n")
    page.write_text("\n".join([title, "", about, made, "", *lines, *words]) + "\n")


if __name__ == "__main__":
    main()
