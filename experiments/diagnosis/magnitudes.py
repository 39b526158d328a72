"""How far the numbers of a report are from the answer's: shares of the gap, the gap itself, and the parameters.

What is read of `report.json`: `parameters` {effect: {name: {value, interval90}}}; `shares` {"effects": {effect: {value,
interval90}}, "sensors": …} of the gap's mean square; `gap` {before, after, floor, reduction}, in floors.
"""

import numpy as np

from experiments.diagnosis.vehicle import GRAVITY, PROPELLER

BRAKING = ("wind", "blade_flapping")  # with what they are, air brakes: see `judge.fine`


def share_errors(answer, prediction):
    """[{"effect", "said", "true"}] of the true effects' shares of the gap's mean square over the floor; said 0 where the report
    doesn't name it. What the report leaves to the sensors is no part of the whole here, as the plant's measure reads none.
    """
    report = prediction["report"]
    if report is None:
        return []
    said = report.get("shares") or {}
    rest = 1.0 - (said.get("sensors") or {}).get("value", 0.0)
    shares, out = said.get("effects", {}), []
    for effect in answer["effects"]:
        if effect not in answer["shares"]:
            continue
        names = [effect, *answer["acceptable"].get(effect, [])]
        entry = next((shares[n] for n in names if n in shares), None)
        value = 0.0 if entry is None else float(entry["value"])
        if (
            entry is not None
            and effect in BRAKING
            and "rotor_drag" in shares
            and entry is not shares["rotor_drag"]
        ):
            value += float(shares["rotor_drag"]["value"])
        value /= max(rest, 0.02)
        out.append(
            {"effect": effect, "said": value, "true": answer["shares"][effect], "named": entry is not None}
        )
    return out


def gap_said(answer, prediction):
    """What the report closes of the gap's excess, over what the true effect closes of it by the plant's measure."""
    gap, truth = (prediction["report"] or {}).get("gap"), answer["gap"]["closed_by_truth"]
    if truth <= 0.02:
        return None
    if not gap or gap.get("reduction") is None:
        return 0.0
    return float(gap["reduction"]) / truth


def before_thrust(answer, prediction):
    """The report's gap before, in floors, of a mass or thrust that is off by 5 to 10 %."""
    cause = next(c for c in answer["causes"] if c["effect"] == answer["effects"][0])
    if cause["effect"] not in ("mass", "thrust_scale") or not 0.05 <= cause["size"] <= 0.10:
        return None
    gap = (prediction["report"] or {}).get("gap") or {}
    return float(gap["before"]) if gap.get("before") is not None else 0.0


def _lag(magnitudes, told):
    return {f"extra_{k}": magnitudes[f"tau_{k}"] - told["motor_time"] for k in ("up", "down")}


def _imbalance(magnitudes, told):
    e = np.array(magnitudes["e"])
    return dict(zip(("m1", "m2", "m3", "m4"), (e - e.mean()).tolist(), strict=True))


def _lateness(magnitudes, told):
    # what a log can show: the cause and the motion capture's own delay; nothing where poses are held
    late = magnitudes.get("logged_ms", magnitudes["delay_ms"])
    return {} if late is None else {"delay": 1e-3 * late}


# effect: (forms that mean the same in the library, true parameters by the library's names, the value that means "absent")
TRUTH = {
    "mass": (("plain",), lambda m, t: {"extra": m["mass_kg"] - t["mass"]}, 0.0),
    "thrust_scale": (("plain", "thrust_only"), lambda m, t: {"scale": m["scale"]}, 0.0),
    "battery_sag": (
        ("linear",),
        lambda m, t: {"exponent": m["thrust_per_volt"] * m["reference_voltage"]},
        0.0,
    ),
    "thrust_saturation": (("hard",), lambda m, t: {"limit": m["limit"]}, 1.0),
    "rotor_drag": (("linear", "raised_hub", "rotor_speed"), lambda m, t: {"d_xy": m["d_xy"]}, 0.0),
    "blade_flapping": (("linear",), lambda m, t: {"stiffness": m["torque_N_m_per_m_s"]}, 0.0),
    "motor_lag": (("slower", "up_down"), _lag, 0.0),
    "command_latency": (("constant", "jitter"), lambda m, t: {"delay": 1e-3 * m["delay_ms"]}, 0.0),
    "packet_loss": (("independent", "bursts"), lambda m, t: {"probability": m["probability"]}, 0.0),
    "thrust_curve": (("quadratic",), lambda m, t: {"curvature": m["curvature"]}, 0.0),
    "motor_imbalance": (("all", "one_weak"), _imbalance, 0.0),
    "com_offset": (("torque", "full"), lambda m, t: {"x": 1e-3 * m["x_mm"], "y": 1e-3 * m["y_mm"]}, 0.0),
    "inertia": (("diagonal",), lambda m, t: dict(zip(("xx", "yy", "zz"), m["ratio"], strict=True)), 1.0),
    "yaw_torque": (("scale",), lambda m, t: {"ratio": m["ratio"]}, 1.0),
    "rate_gains": (("gains",), lambda m, t: {"p": m["kp"]}, 1.0),
    "state_latency": (("constant", "jitter"), _lateness, 0.0),
}


def parameters(answer, prediction):
    """[{"effect", "error", "covered", "half_widths", "severity"}] of the true causes whose parameters the report gives.

    The error is |estimate - truth| / |truth - absent|, vectors taken as one; surface effects and wakes are compared as
    what they do at one distance.
    """
    said, rows = (prediction["report"] or {}).get("parameters") or {}, []
    for cause in answer["causes"]:
        effect, magnitudes = cause["effect"], cause["magnitudes"]
        fitted = said.get(effect)
        if not fitted:
            continue
        values = {k: v["value"] for k, v in fitted.items() if v.get("value") is not None}
        row = {"effect": effect, "severity": answer["severity"], "covered": [], "half_widths": []}
        derived = _derived(effect, cause, values)
        if derived is not None:
            estimate, true = derived
            rows.append(
                row | {"error": float(np.linalg.norm(np.subtract(estimate, true)) / np.linalg.norm(true))}
            )
            continue
        forms, truth_of, absent = TRUTH.get(effect, ((), None, 0.0))
        if cause["form"] not in forms:
            continue
        truth = truth_of(magnitudes, answer["told"])
        if not truth or not set(truth) <= set(values):
            continue
        estimate, true = np.array([values[k] for k in truth]), np.array(list(truth.values()))
        centre = (
            estimate.mean() if effect == "motor_imbalance" else 0.0
        )  # the common part is the thrust scale's
        size = float(np.linalg.norm(true - absent))
        for k, t in truth.items():
            interval = fitted[k].get("interval90")
            if interval:
                row["covered"].append(bool(interval[0] - centre <= t <= interval[1] - centre))
                row["half_widths"].append(
                    0.5 * (interval[1] - interval[0]) / max(abs(t - absent), 0.3 * size)
                )
        rows.append(row | {"error": float(np.linalg.norm(estimate - centre - true)) / size})
    return rows


def _derived(effect, cause, values):
    m = cause["magnitudes"]
    if effect in ("ground_effect", "ceiling_effect") and "strength" in values:
        return values["strength"] * (PROPELLER / (0.05 + values.get("offset", 0.0))) ** 2, m["gain_at_5cm"]
    if effect == "wind" and {"x", "y", "drag"} <= set(values) and cause["form"] == "steady":
        # the force at rest: speed and drag apart show far less than their product
        return values["drag"] * np.array([values["x"], values["y"]]), m["drag"] * np.array(
            [m["w_x"], m["w_y"]]
        )
    if effect == "downwash" and "force" in values and cause["form"] == "gaussian":
        length = values.get("length", 0.5)
        return values["force"] * np.exp(-0.25 / length), 1e-3 * GRAVITY * m["A_g"] * np.exp(
            -0.25 / m["height_m"]
        )
    return None
