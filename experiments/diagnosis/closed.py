"""How far reports close the gap, by the plant's own measure.

    python -m experiments.diagnosis.closed ANSWERS.json DIAGNOSES --out CLOSED.json [--jobs 8]

Every case with a cause of the vocabulary is flown again from its seed; the effects that its report accepts, with the
parameters that it gives, are put into the plant in place of the true ones and measured as `generate` measured the truth
(see `measure`). Written per case: `closed`, the fall of the gap's root mean square in floors over the fall that the
truth brings. A report that names nothing closes 0; a name without a counterpart in the plant is left out.
"""

import json
import multiprocessing
from pathlib import Path

import numpy as np

from experiments.diagnosis import cases, fleet, judge

SKIPPED = ("packet_loss",)  # which packets were lost isn't a parameter


def put(effect, said, p, c):
    """Write an effect as a report describes it into the plant's parameters of the bodies `c`."""

    def get(name, default=0.0):
        return said.get(name, default)

    if effect == "mass":
        p["mass"][c] += get("extra")
    elif effect == "thrust_scale":
        p["rotor_gain"][:, c] *= 1 + get("scale")
    elif effect == "battery_sag":
        p["sag_power"][c], p["sag_reference"][c] = get("exponent"), get("reference", 3.9)
    elif effect == "thrust_saturation":
        # the report's limit holds at 3.9 V, the plant's at 3.6 V
        slope = get("voltage_slope")
        p["limit"][c] = get("limit", 1.0) * (1 - 0.3 * slope)
        p["limit_voltage"][c] = slope / (1 - 0.3 * slope)
    elif effect == "thrust_curve":
        p["curve_map"][:, c] = np.array([get("offset"), get("slope", 1.0), get("curvature")])[:, None]
    elif effect == "rotor_drag":
        p["drag_xy"][c], p["drag_z"][c] = get("d_xy"), get("d_z")
    elif effect == "blade_flapping":
        p["flap_tilt"][c], p["flap_torque"][c] = get("tilt"), get("stiffness")
    elif effect == "wind":
        p["wind"][:, c] = np.array([get("x"), get("y"), get("z")])[:, None]
        p["wind_drag"][c] = get("drag")
    elif effect in ("ground_effect", "ceiling_effect"):
        side = effect.split("_")[0]
        p[side + "_inverse"][c], p[side + "_offset"][c] = get("strength"), max(get("offset"), 0.0) + 1e-3
    elif effect == "downwash":
        p["wake"][c], p["wake_height"][c] = get("force"), get("length", 0.5)
        p["wake_width"][c], p["wake_spread"][c] = get("width", 0.05), get("spread", 0.1)
    elif effect == "motor_lag":
        p["tau_up"][c] = np.maximum(p["tau_up"][c] + get("extra_up"), 0.003)
        p["tau_down"][c] = np.maximum(p["tau_down"][c] + get("extra_down"), 0.003)
    elif effect == "command_latency":
        p["link_delay"][c] = 1e3 * get("delay")
    elif effect == "motor_imbalance":
        p["rotor_gain"][:, c] *= 1 + np.array([get(f"m{i}") for i in (1, 2, 3, 4)])[:, None]
    elif effect == "com_offset":
        p["com"][:, c] = np.array([get("x"), get("y"), get("z")])[:, None]
    elif effect == "inertia":
        for i, axis in enumerate(("xx", "yy", "zz")):
            p["inertia"][i, i, c] *= get(axis, 1.0)
    elif effect == "yaw_torque":
        p["torque_ratio"][c] *= get("ratio", 1.0)
    elif effect == "rate_gains":
        for key in "pid":
            p["k" + key][:, c] *= get(key, 1.0)
    elif effect == "state_latency":
        p["pose_delay"][c] = 1e3 * get("delay")


def close_chunk(job):
    """{case: share closed} of a list of (spec, answer, report)."""
    seed, column, rows = job
    variants = []
    for spec, answer, _ in rows:
        causes = [{k: x for k, x in c.items() if k != "magnitudes"} for c in answer["causes"]]
        variants.append((spec, causes))
    drawn = {s["name"]: fleet.bodies(seed, column, s) for s, _ in variants}
    flown = fleet.Fleet(seed, column, variants, drawn)
    p = flown.model([[] for _ in variants])[0]
    links, firmware = np.zeros((2, len(flown.told)), bool)
    for (_, answer, report), columns in zip(rows, flown.columns, strict=True):
        firmware[columns] = any(c["effect"] in fleet.FIRMWARE for c in answer["causes"])
        for effect in report["effects"]:
            values = {
                k: v["value"]
                for k, v in (report["parameters"].get(effect) or {}).items()
                if v.get("value") is not None
            }
            put(effect, values, p, columns)
            firmware[columns] |= effect in ("rate_gains", "command_latency")
    said, squares = flown.errors_of(p, firmware, links), flown.energies()
    out = {}
    for i, (_, answer, _) in enumerate(rows):
        floor = np.array(
            [np.inf if answer["floor"][c] is None else answer["floor"][c] for c in answer["floor"]]
        )
        known = np.isfinite(floor)
        quiet = np.maximum(floor[known] ** 2 - squares["truth"][known, i], 0.0)
        before, after, best = (
            float(np.sqrt(((square[known, i] + quiet) / floor[known] ** 2).mean()))
            for square in (squares["nominal"], said, squares["truth"])
        )
        out[answer["case"]] = float((before - after) / max(before - best, 1e-9))
    return out


def close_all(answers, predictions, jobs=1, chunk=8):
    """{case: share closed} of the single causes and pairs that the logs show."""
    specs = {s["name"]: s for s in cases.draw_cases(answers["seed"], answers["column"], answers["count"])}
    rows = []
    for name, answer in answers["cases"].items():
        report = (predictions.get(name) or {}).get("report")
        shown = answer["category"] in ("single", "pair") and answer["severity"] in ("medium", "high")
        if shown and report and not set(answer["effects"]) & set(SKIPPED):
            rows.append((specs[name], answer, report))
    work = [(answers["seed"], answers["column"], rows[i : i + chunk]) for i in range(0, len(rows), chunk)]
    out = {}
    if jobs == 1:
        for job in work:
            out |= close_chunk(job)
    else:
        with multiprocessing.get_context("spawn").Pool(min(jobs, max(1, len(work)))) as pool:
            for part in pool.imap_unordered(close_chunk, work):
                out |= part
    return out


def main():
    parser = judge.reports_parser(__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    closed = close_all(
        json.loads(options.answers.read_text()), judge.collect(options.diagnoses), options.jobs
    )
    options.out.write_text(json.dumps(dict(sorted(closed.items())), indent=1))


if __name__ == "__main__":
    main()
