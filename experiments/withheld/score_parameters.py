"""Recovered parameters against the true magnitudes.

Only forms whose parameters mean the same in the library are compared; others (a quadratic drag against a
linear one) have no true value. What a nuisance of the case adds in the same way (thrust offset to a scale,
clock offset to a delay) counts as part of the truth, since no flight can split it off. A relative error is
|estimate - truth| / |truth - none|, with vectors (imbalance, offset, lag up and down) taken as one.
"""

import numpy as np

from experiments.withheld.body import GRAVITY, MASS, MOTOR_TIME, PROPELLER


def _imbalance(magnitudes):
    e = np.array(magnitudes["e"])
    return dict(zip(("m1", "m2", "m3", "m4"), e - e.mean(), strict=True))


# effect: (forms that compare, true parameters by the library's names, the value of each that means "absent")
TRUTH = {
    "mass": (("plain",), lambda m: {"extra": m.get("seen_extra_kg", m["mass_kg"] - MASS)}, 0.0),
    "thrust_scale": (("plain",), lambda m: {"scale": m.get("seen_scale", m["scale"])}, 0.0),
    "battery_sag": (("linear",), lambda m: {"exponent": m["thrust_per_volt"] * m["reference_voltage"]}, 0.0),
    "thrust_saturation": (("hard",), lambda m: {"limit": m["limit"]}, 1.0),
    "rotor_drag": (("linear", "raised_hub", "rotor_speed"), lambda m: {"d_xy": m["d_xy"]}, 0.0),
    "blade_flapping": (("linear",), lambda m: {"stiffness": m["torque_N_m_per_m_s"]}, 0.0),
    "motor_lag": (
        ("slower", "up_down"),
        lambda m: {"extra_up": m["tau_up"] - MOTOR_TIME, "extra_down": m["tau_down"] - MOTOR_TIME},
        0.0,
    ),
    "command_latency": (("constant", "jitter"), lambda m: {"delay": 1e-3 * m["delay_ms"]}, 0.0),
    "packet_loss": (("independent", "bursts"), lambda m: {"probability": m["probability"]}, 0.0),
    "thrust_curve": (("quadratic",), lambda m: {"curvature": m["curvature"]}, 0.0),
    "motor_imbalance": (("all", "one_weak"), _imbalance, 0.0),
    "com_offset": (("torque", "full"), lambda m: {"x": 1e-3 * m["x_mm"], "y": 1e-3 * m["y_mm"]}, 0.0),
    "inertia": (("diagonal",), lambda m: dict(zip(("xx", "yy", "zz"), m["ratio"], strict=True)), 1.0),
    "yaw_torque": (("scale",), lambda m: {"ratio": m["ratio"]}, 1.0),
    "rate_gains": (("gains",), lambda m: {"p": m["kp"]}, 1.0),
    "state_latency": (
        ("constant", "jitter"),
        lambda m: {"delay": 1e-3 * m.get("seen_delay_ms", m["delay_ms"])},
        0.0,
    ),
}


def _relative(estimate, truth):
    return float(np.linalg.norm(np.subtract(estimate, truth)) / np.linalg.norm(truth))


def _derived(effect, cause, values):
    """(estimate, truth) of surface and wake effects, compared as what they do at one distance, whatever their
    form.
    """
    m = cause["magnitudes"]
    if effect in ("ground_effect", "ceiling_effect") and "strength" in values:
        return values["strength"] * (PROPELLER / (0.05 + values.get("offset", 0.0))) ** 2, m["gain_at_5cm"]
    if effect == "wind" and {"x", "y", "drag"} <= set(values) and cause["form"] == "steady":
        # the force at rest: speed and drag apart show far less than their product
        estimate = values["drag"] * np.array([values["x"], values["y"]])
        return estimate, m["drag"] * np.array([m["w_x"], m["w_y"]])
    if effect == "downwash" and "force" in values and cause["form"] == "gaussian":
        length = values.get("length", 0.5)
        return values["force"] * np.exp(-0.25 / length), 1e-3 * GRAVITY * m["A_g"] * np.exp(
            -0.25 / m["height_m"]
        )
    return None


def compare(answer, report):
    """Per true cause that the report fitted too: {"effect", "relative_error", "covered": [...]}; [] if
    nothing compares.
    """
    rows = []
    for cause in answer["causes"]:
        effect = cause["effect"]
        fitted = (report.get("parameters") or {}).get(effect)
        if not fitted:
            continue
        values = {k: v["value"] for k, v in fitted.items() if v.get("value") is not None}
        derived = _derived(effect, cause, values)
        if derived is not None:
            rows.append(
                {
                    "effect": effect,
                    "relative_error": _relative(*derived),
                    "covered": [],
                }
            )
            continue
        forms, truth_of, none = TRUTH.get(effect, ((), None, 0.0))
        if cause["form"] not in forms:
            continue
        truth = truth_of(cause["magnitudes"])
        if not set(truth) <= set(values):
            continue
        estimate = np.array([values[k] for k in truth])
        true = np.array(list(truth.values()))
        if effect == "motor_imbalance":  # the common part is the thrust scale's
            estimate = estimate - np.mean([values[k] for k in ("m1", "m2", "m3", "m4")])
        covered = [
            bool(fitted[k]["interval90"][0] <= t <= fitted[k]["interval90"][1])
            for k, t in truth.items()
            if fitted[k].get("interval90") and effect != "motor_imbalance"
        ]
        rows.append(
            {
                "effect": effect,
                "relative_error": float(np.linalg.norm(estimate - true) / np.linalg.norm(true - none)),
                "covered": covered,
            }
        )
    return rows
