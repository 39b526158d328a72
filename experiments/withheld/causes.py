"""The vocabulary inside the withheld plant: forms of each effect, how a size is turned into parameters, and
what has to be flown to see it.

A cause is {"effect", "form", "size", "shape"}: `size` is the one number that severity calibration moves,
`shape` are eight uniform draws that fix everything else (signs, axes, ratios), once per case. Form 0 is close
to what any library would write; the others are not. `LIMITS` are the smallest and largest size that are
drawn, about the usual ranges of vehicles of this size.
"""

import numpy as np

from experiments.withheld import body as b

# effect: (smallest, start, largest) size, missions that expose it, number of forms
LIMITS = {
    "mass": (0.02, 0.06, 0.30),
    "thrust_scale": (0.02, 0.05, 0.22),
    "battery_sag": (0.10, 0.3, 1.4),
    "thrust_saturation": (0.03, 0.12, 0.27),
    "rotor_drag": (0.003, 0.010, 0.035),
    "blade_flapping": (0.05, 0.3, 3.0),
    "wind": (0.2, 0.8, 3.0),
    "ground_effect": (0.015, 0.1, 0.35),
    "ceiling_effect": (0.015, 0.1, 0.35),
    "downwash": (2.0, 8.0, 20.0),
    "motor_lag": (0.2, 0.8, 3.5),
    "command_latency": (4.0, 12.0, 60.0),
    "packet_loss": (0.01, 0.12, 0.5),
    "thrust_curve": (0.05, 0.25, 1.0),
    "motor_imbalance": (0.003, 0.02, 0.15),
    "com_offset": (0.05, 0.6, 8.0),
    "inertia": (0.06, 0.2, 0.6),
    "yaw_torque": (0.06, 0.25, 0.85),
    "rate_gains": (0.08, 0.3, 1.0),
    "state_latency": (4.0, 15.0, 60.0),
}
EFFECTS = tuple(LIMITS)
FORMS = {
    "mass": ("plain", "payload"),
    "thrust_scale": ("plain", "thrust_only"),
    "battery_sag": ("linear", "power", "quadratic", "load"),
    "thrust_saturation": ("hard", "voltage", "soft"),
    "rotor_drag": ("linear", "quadratic", "rotor_speed", "raised_hub"),
    "blade_flapping": ("linear", "advance_ratio"),
    "wind": ("steady", "quadratic", "shear", "gusty"),
    "ground_effect": ("inverse_square", "cheeseman_bennett", "exponential"),
    "ceiling_effect": ("inverse_square", "cheeseman_bennett", "exponential"),
    "downwash": ("gaussian", "jet"),
    "motor_lag": ("slower", "up_down", "second_order"),
    "command_latency": ("constant", "jitter", "spikes"),
    "packet_loss": ("independent", "bursts"),
    "thrust_curve": ("quadratic", "power", "dip"),
    "motor_imbalance": ("all", "one_weak"),
    "com_offset": ("torque", "full"),
    "inertia": ("diagonal", "products"),
    "yaw_torque": ("scale",),
    "rate_gains": ("gains", "filtered_d"),
    "state_latency": ("constant", "jitter"),
}
EXPOSING = {
    "battery_sag": ("climb", "agile", "step"),
    "thrust_saturation": ("climb",),
    "rotor_drag": ("fast", "agile", "spiral"),
    "blade_flapping": ("fast", "agile", "spiral"),
    "wind": ("yaw", "fast", "hover"),
    "ground_effect": ("low",),
    "ceiling_effect": ("high",),
    "downwash": ("pass", "pass_moving"),
    "motor_lag": ("agile", "step"),
    "command_latency": ("agile", "step", "yaw"),
    "packet_loss": ("agile", "step", "yaw"),
    "thrust_curve": ("climb",),
    "inertia": ("agile", "step", "yaw"),
    "yaw_torque": ("yaw",),
    "rate_gains": ("agile", "step", "yaw"),
    "state_latency": ("agile", "fast", "step"),
}


def draw(rng, effect, form=None):
    """A cause of the effect with a start size; the form is drawn unless given."""
    forms = FORMS[effect]
    form = forms[int(rng.integers(len(forms)))] if form is None else form
    return {"effect": effect, "form": form, "size": LIMITS[effect][1], "shape": rng.uniform(0, 1, 8).tolist()}


def apply(cause, p, columns, arrival=None, rng=None):
    """Write the cause into the parameters of the bodies `columns`; the link's effects change `arrival` (K, B)
    instead.

    Returns the magnitudes in the units of `openjax.vehicle.effects`.
    """
    name, form, a, s = cause["effect"], cause["form"], float(cause["size"]), np.asarray(cause["shape"])
    sign = 1.0 if s[0] < 0.5 else -1.0
    c = columns
    if name == "mass":
        p["mass"][c] *= 1 + sign * a
        if form == "payload":
            for i in range(3):
                p["inertia"][i, i, c] *= 1 + 0.3 * sign * a
        return {"mass_kg": b.MASS * (1 + sign * a), "ratio": 1 + sign * a}
    if name == "thrust_scale":
        p["rotor_gain"][:, c] *= 1 + sign * a
        if form == "thrust_only":
            p["torque_gain"][c] /= 1 + sign * a
        return {"scale": sign * a}
    if name == "battery_sag":
        reference = 3.6 + 0.25 * s[1]
        p["sag_reference"][c] = reference
        if form in ("linear", "power"):
            p["sag_power"][c] = a * (reference if form == "linear" else 3.7)
        else:
            p["sag_quadratic" if form == "quadratic" else "sag_load"][c] = a
        return {"thrust_per_volt": a, "reference_voltage": reference}
    if name == "thrust_saturation":
        top = 0.9 - a
        p["limit"][c] = top
        p["limit_voltage"][c] = 0.25 if form == "voltage" else 0.0
        p["limit_knee"][c] = 0.015 if form == "soft" else 0.0
        return {"limit": top}
    if name == "rotor_drag":
        ratio = 0.3 + 0.6 * s[1]
        values = {"d_xy": a, "d_z": a * ratio}
        if form == "linear":
            p["drag_xy"][c], p["drag_z"][c] = a, a * ratio
        elif form == "quadratic":
            p["drag_xy"][c], p["drag_z"][c], p["drag_quadratic"][c] = 0.5 * a, 0.5 * a, 0.5 * a
        elif form == "rotor_speed":
            p["drag_rotor"][c] = a / (4 * 0.79)  # at hover speed the four hubs add up to a
            values["d_z"] = 0.5 * a
        else:
            p["drag_xy"][c], p["drag_z"][c], p["drag_height"][c] = a, a * ratio, 0.002 + 0.003 * s[2]
        return values
    if name == "blade_flapping":
        # size: torque at hover thrust in 1e-4 N m per m/s; the thrust leans by 0.004 to 0.03 rad per m/s
        p["flap_torque"][c], p["flap_tilt"][c] = 1e-4 * a, (0.004 + 0.02 * s[1]) * min(a, 1.3)
        p["flap_advance"][c] = 30.0 if form == "advance_ratio" else 0.0
        return {"torque_N_m_per_m_s": 1e-4 * a, "tilt_rad_per_m_s": float(p["flap_tilt"][c][0])}
    if name == "wind":
        angle = 2 * np.pi * s[1]
        p["wind"][:, c] = (a * np.array([np.cos(angle), np.sin(angle), 0.3 * (s[2] - 0.5)]))[:, None]
        # low severities need less drag than the speed's lower limit alone leaves
        drag = (0.008 + 0.010 * s[3]) * min(1.0, max(0.3, a / 0.6))
        p["wind_quadratic" if form == "quadratic" else "wind_drag"][c] = drag
        p["wind_shear"][c] = 0.8 if form == "shear" else 0.0
        p["wind_gust"][c] = 0.3 if form == "gusty" else 0.0
        return {"w_x": float(a * np.cos(angle)), "w_y": float(a * np.sin(angle)), "speed": a, "drag": drag}
    if name in ("ground_effect", "ceiling_effect"):
        side = name.split("_")[0]
        offset = 0.01 + 0.02 * s[1]
        p[side + "_offset"][c] = offset
        # size: gain of thrust 5 cm from the surface
        if form == "inverse_square":
            p[side + "_inverse"][c] = a * ((0.05 + offset) / b.PROPELLER) ** 2
        elif form == "cheeseman_bennett":
            ratio = a / (1 + a)
            p[side + "_image"][c] = 4 * (0.05 + offset) / b.PROPELLER * np.sqrt(ratio)
        else:
            scale = 0.035 + 0.04 * s[2]
            p[side + "_scale"][c] = scale
            p[side + "_exp"][c] = a * np.exp((0.05 + offset) / scale)
        return {"gain_at_5cm": a, "offset": offset}
    if name == "downwash":
        p["wake"][c] = a * 1e-3 * b.GRAVITY
        p["wake_width"][c], p["wake_spread"][c] = 0.03 + 0.02 * s[1], 0.06 + 0.08 * s[2]
        p["wake_height"][c] = 0.25 + 0.5 * s[3]
        p["wake_jet"][c] = 1.0 if form == "jet" else 0.0
        return {"A_g": a, "width_m": float(p["wake_width"][c][0]), "height_m": float(p["wake_height"][c][0])}
    if name == "motor_lag":
        up, down = (1 + a), (1 + a)
        if form == "up_down":
            up, down = 1 + a * (0.5 + 0.4 * s[1]), 1 + a * (1.1 + 0.6 * s[2])
        p["tau_up"][c], p["tau_down"][c] = b.MOTOR_TIME * up, b.MOTOR_TIME * down
        if form == "second_order":
            p["tau_up"][c] = p["tau_down"][c] = b.MOTOR_TIME * (1 + 0.7 * a)
            p["tau_second"][c] = b.MOTOR_TIME * 0.3 * a
        return {"tau_up": b.MOTOR_TIME * up, "tau_down": b.MOTOR_TIME * down}
    if name == "command_latency":
        ticks = arrival.shape[0]
        for j in np.atleast_1d(c):
            extra = np.full(ticks, a)
            if form == "jitter":
                extra = a * (0.75 + 0.5 * rng.uniform(0, 1, ticks))
            elif form == "spikes":
                extra = a * (0.85 + (rng.uniform(0, 1, ticks) < 0.1) * rng.uniform(0.5, 2.5, ticks))
            arrival[:, j] += np.rint(extra)
        return {"delay_ms": a}
    if name == "packet_loss":
        ticks = arrival.shape[0]
        for j in np.atleast_1d(c):
            if form == "independent":
                lost = rng.uniform(0, 1, ticks) < a
            else:  # Gilbert-Elliott: bad spells of some 5 packets, in which nearly all are lost
                stay = 0.8
                enter = (1 - stay) * a / max(0.95 - a, 0.05)
                bad, lost, draws = False, np.zeros(ticks, bool), rng.uniform(0, 1, (ticks, 2))
                for k in range(ticks):
                    bad = draws[k, 0] < stay if bad else draws[k, 0] < enter
                    lost[k] = bad and draws[k, 1] < 0.95
            arrival[lost, j] = 10**8
        return {"probability": a}
    return _apply_body(name, form, a, s, sign, p, c)


def _apply_body(name, form, a, s, sign, p, c):
    """The effects on rotors, inertia, rate loop and pose."""
    if name == "thrust_curve":
        if form == "quadratic":
            # a u^2 + ... through the hover point, slope there changed too: the curvature is the cause
            root = 0.35 + 0.2 * s[1]
            curve = sign * a
            p["curve_c"][c], p["curve_b"][c], p["curve_a"][c] = (
                curve,
                1 - curve * (0.625 + root),
                curve * 0.625 * root,
            )
            return {"curvature": curve, "root": root}
        if form == "power":
            p["curve_power"][c] = 1 + sign * min(a, 0.9)
            return {"power": 1 + sign * min(a, 0.9)}
        p["curve_dip"][c] = sign * 0.3 * a
        return {"dip": sign * 0.3 * a}
    if name == "motor_imbalance":
        if form == "all":
            e = 2 * s[1:5] - 1
            e -= e.mean() * 0.8
            e = a * e / np.abs(e).max()
        else:
            e = np.zeros(4)
            e[int(4 * s[1])] = -a
        p["rotor_gain"][:, c] *= (1 + e)[:, None]
        return {"e": e.tolist()}
    if name == "com_offset":
        angle = 2 * np.pi * s[1]
        offset = a * 1e-3 * np.array([np.cos(angle), np.sin(angle), 0.0])
        p["com"][:, c] = offset[:, None]
        p["imu_lever"][c] = 1.0 if form == "full" else 0.0
        return {"x_mm": float(1e3 * offset[0]), "y_mm": float(1e3 * offset[1])}
    if name == "inertia":
        high = s[0] < 0.7
        factors = (1 + a * (0.6 + 0.4 * s[1:4])) if high else 1 / (1 + a * (0.6 + 0.4 * s[1:4]))
        for i in range(3):
            p["inertia"][i, i, c] *= factors[i]
        if form == "products":
            product = 0.12 * b.INERTIA[0] * (2 * s[4] - 1)
            p["inertia"][0, 1, c] = p["inertia"][1, 0, c] = product
        return {"ratio": factors.tolist()}
    if name == "yaw_torque":
        # mostly below the nominal, down to 0.15; sometimes above, up to 2
        factor = 1 - a if s[0] < 0.7 else 1 + a
        p["torque_ratio"][c] *= factor
        return {"ratio": factor}
    if name == "rate_gains":
        factors = np.stack([(1 + a) ** (2 * s[1] - 1), (1 + a) ** (2 * s[2] - 1), (1 + a) ** (2 * s[3] - 1)])
        main = (1 + a) if s[0] < 0.5 else 1 / (1 + a)
        factors[0] = main
        p["kp"][:, c] *= factors[0]
        p["ki"][:, c] *= factors[1]
        p["kd"][:, c] *= factors[2]
        p["d_filter"][c] = 0.004 if form == "filtered_d" else 0.0
        return {"kp": float(factors[0]), "ki": float(factors[1]), "kd": float(factors[2])}
    if name == "state_latency":
        p["pose_delay"][c] = a
        p["pose_jitter"][c] = 0.2 * a if form == "jitter" else 0.0
        return {"delay_ms": a}
    raise ValueError(f"unknown effect {name!r}")
