"""How far the parameters of a report are from the answer's, and whether their intervals hold the
truth.

What is read of `report.json`: `parameters` {effect: {name: {value, interval90}}}.
"""

import numpy as np

from experiments.diagnosis.vehicle import GRAVITY, PROPELLER


def _lag(magnitudes, told):
    return {f"extra_{k}": magnitudes[f"tau_{k}"] - told["motor_time"] for k in ("up", "down")}


def _imbalance(magnitudes, told):
    e = np.array(magnitudes["e"])
    return dict(zip(("m1", "m2", "m3", "m4"), (e - e.mean()).tolist(), strict=True))


def _lateness(magnitudes, told):
    # what a log can show: the cause and the motion capture's own delay; nothing where
    # poses are held
    late = magnitudes.get("logged_ms", magnitudes["delay_ms"])
    return {} if late is None else {"delay": 1e-3 * late}


# effect: (forms that mean the same in the library, true parameters by the library's
# names, the value that means "absent")
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
    "com_offset": (
        ("torque", "full"),
        lambda m, t: {"x": 1e-3 * m["x_mm"], "y": 1e-3 * m["y_mm"]},
        0.0,
    ),
    "inertia": (
        ("diagonal",),
        lambda m, t: dict(zip(("xx", "yy", "zz"), m["ratio"], strict=True)),
        1.0,
    ),
    "yaw_torque": (("scale",), lambda m, t: {"ratio": m["ratio"]}, 1.0),
    "rate_gains": (("gains",), lambda m, t: {"p": m["kp"]}, 1.0),
    "state_latency": (("constant", "jitter"), _lateness, 0.0),
}


def parameters(answer, report):
    """[{"effect", "error", "covered"}] of the true causes whose parameters the report gives.

    The error is |estimate - truth| / |truth - absent|, vectors taken as one; surface effects and
    wakes are compared as what they do at one distance.
    """
    said = (report or {}).get("parameters") or {}
    rows = []
    for cause in answer.get("causes", ()):
        effect = cause["effect"]
        magnitudes = cause["magnitudes"]
        fitted = said.get(effect)
        if not fitted:
            continue
        values = {k: v["value"] for k, v in fitted.items() if v.get("value") is not None}
        row = {"effect": effect, "covered": []}
        derived = _derived(effect, cause, values)
        if derived is not None:
            off = np.linalg.norm(np.subtract(*derived))
            rows.append(row | {"error": float(off / np.linalg.norm(derived[1]))})
            continue
        forms, truth_of, absent = TRUTH.get(effect, ((), None, 0.0))
        if cause["form"] not in forms:
            continue
        truth = truth_of(magnitudes, answer["told"])
        if not truth or not set(truth) <= set(values):
            continue
        estimate = np.array([values[k] for k in truth])
        true = np.array(list(truth.values()))
        # the common part is the thrust scale's
        centre = estimate.mean() if effect == "motor_imbalance" else 0.0
        size = float(np.linalg.norm(true - absent))
        for k, t in truth.items():
            interval = fitted[k].get("interval90")
            if interval:
                row["covered"].append(bool(interval[0] - centre <= t <= interval[1] - centre))
        rows.append(row | {"error": float(np.linalg.norm(estimate - centre - true)) / size})
    return rows


def _derived(effect, cause, values):
    m = cause["magnitudes"]
    if effect in ("ground_effect", "ceiling_effect") and "strength" in values:
        return values["strength"] * (PROPELLER / (0.05 + values.get("offset", 0.0))) ** 2, m[
            "gain_at_5cm"
        ]
    if effect == "wind" and {"x", "y", "drag"} <= set(values) and cause["form"] == "steady":
        # the force at rest: speed and drag apart show far less than their product
        said = np.array([values["x"], values["y"]])
        true = np.array([m["w_x"], m["w_y"]])
        return values["drag"] * said, m["drag"] * true
    if effect == "downwash" and "force" in values and cause["form"] == "gaussian":
        said = values["force"] * np.exp(-0.25 / values.get("length", 0.5))
        return said, 1e-3 * GRAVITY * m["A_g"] * np.exp(-0.25 / m["height_m"])
    return None
