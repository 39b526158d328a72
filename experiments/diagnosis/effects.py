"""How the twenty effects act inside the plant, and how a drawn cause is written into the plant's
parameters.

A cause is {"effect", "form", "size", "shape"}: `size` is the one number that decides the severity,
`shape` are eight uniform draws that fix everything else (signs, axes, ratios), once per case. The
first form of an effect is close to what any library would write; the others are not. Arrays have
the body index last.
"""

from typing import NamedTuple

import numpy as np

from experiments.diagnosis.vehicle import (
    CEILING,
    GRAVITY,
    MAX_SPEED,
    PROPELLER,
    ROTOR_X,
    ROTOR_Y,
    cross,
    rotate_back,
)


class Drawn(NamedTuple):
    """What is drawn of an effect: (smallest, largest) size, forms, missions that expose it, logged
    channels that it needs.
    """

    sizes: tuple
    forms: tuple
    missions: tuple
    needs: str


SURFACE = ("inverse_square", "cheeseman_bennett", "exponential")
_EFFECTS = {
    "mass": ((0.02, 0.30), ("plain", "payload"), (), "m"),
    "thrust_scale": ((0.02, 0.22), ("plain", "thrust_only"), (), "m"),
    "battery_sag": (
        (0.10, 1.2),
        ("linear", "power", "quadratic", "load"),
        ("climb", "agile", "step"),
        "mv",
    ),
    "thrust_saturation": ((0.1, 0.95), ("hard", "voltage", "soft"), ("climb",), "m"),
    "rotor_drag": (
        (0.003, 0.035),
        ("linear", "quadratic", "rotor_speed", "raised_hub"),
        ("fast", "laps", "spiral"),
        "p",
    ),
    "blade_flapping": ((0.05, 3.0), ("linear", "advance_ratio"), ("fast", "agile", "laps"), "pg"),
    "wind": ((0.2, 12.0), ("steady", "quadratic", "shear", "gusty"), ("yaw", "fast", "hover"), "p"),
    "ground_effect": ((0.015, 0.35), SURFACE, ("low",), "pm"),
    "ceiling_effect": ((0.015, 0.35), SURFACE, ("high",), "pm"),
    "downwash": ((2.0, 20.0), ("gaussian", "jet"), ("pass", "pass_moving"), "pm"),
    "motor_lag": (
        (0.2, 3.5),
        ("slower", "up_down", "second_order", "brushed"),
        ("agile", "step"),
        "gm",
    ),
    "command_latency": (
        (4.0, 60.0),
        ("constant", "jitter", "spikes"),
        ("agile", "step", "yaw"),
        "gcm",
    ),
    "packet_loss": ((0.01, 0.5), ("independent", "bursts"), ("agile", "step", "yaw"), "gcm"),
    "thrust_curve": ((0.05, 1.0), ("quadratic", "power", "dip"), ("climb",), "m"),
    "motor_imbalance": ((0.003, 0.15), ("all", "one_weak"), (), "gm"),
    "com_offset": ((0.05, 8.0), ("torque", "full"), (), "gm"),
    "inertia": ((0.06, 0.6), ("diagonal", "products"), ("agile", "step", "yaw"), "gm"),
    "yaw_torque": ((0.06, 0.85), ("scale",), ("yaw",), "gm"),
    "rate_gains": ((0.08, 1.0), ("gains", "filtered_d"), ("agile", "step", "yaw"), "gcm"),
    "state_latency": ((4.0, 60.0), ("constant", "jitter"), ("agile", "fast", "step"), "pg"),
}
EFFECTS = {name: Drawn(*drawn) for name, drawn in _EFFECTS.items()}
# effects that can stand in for one another: not drawn together
FAMILIES = (
    ("mass", "thrust_scale", "battery_sag"),
    ("rotor_drag", "wind", "blade_flapping"),
    ("motor_imbalance", "com_offset"),
    ("inertia", "yaw_torque", "rate_gains"),
    ("thrust_curve", "thrust_saturation", "battery_sag"),
    ("command_latency", "packet_loss"),
)

# (effect, form) -> names that describe a part of it: no mistake beside its own
PARTS = {
    ("mass", "payload"): ("inertia",),
    ("rotor_drag", "raised_hub"): ("blade_flapping",),
    ("motor_imbalance", "one_weak"): ("thrust_scale", "mass"),
    ("command_latency", "spikes"): ("packet_loss",),
}


class Active:
    """Which parameters differ from their neutral value somewhere in the batch."""

    def __init__(self, parameters, neutral):
        self.names = {k for k, v in parameters.items() if k in neutral and np.any(v != neutral[k])}

    def __call__(self, *names):
        return any(n in self.names for n in names)


def motor_demand(p, active, m, voltage, load):
    """Motor commands (4, B) to effective thrust fraction: thrust map, battery, saturation, in this
    order.
    """
    u = m
    hover = p["hover"]
    if active("curve_map"):
        u = p["curve_map"][0] + (p["curve_map"][1] + p["curve_map"][2] * m) * m
    if active("curve_quadratic"):
        u = u + p["curve_quadratic"] * (m - hover) * (m - p["curve_root"])
    if active("curve_power"):
        u = hover * np.power(np.clip(u, 1e-6, None) / hover, p["curve_power"])
    if active("curve_dip"):
        u = u - p["curve_dip"] * np.exp(-0.5 * ((m - hover + 0.12) / 0.12) ** 2)
    if active("sag_power"):
        u = u * np.power(voltage / p["sag_reference"], p["sag_power"])
    if active("sag_quadratic"):
        drop = np.clip(p["sag_reference"] - voltage, -1.0, None)
        u = u * (1.0 - p["sag_quadratic"] * (drop + 0.6 * drop * np.abs(drop)))
    if active("sag_load"):
        u = u * (1.0 - p["sag_load"] * ((p["sag_reference"] - voltage) + 0.1 * (load - 0.6)))
    if active("limit"):
        top = p["limit"] * (1.0 + p["limit_voltage"] * (voltage - 3.6))
        knee = np.maximum(p["limit_knee"], 1e-6)
        soft = top - knee * np.logaddexp(0.0, np.clip((top - u) / knee, -700, 700))
        u = np.where(p["limit_knee"] > 0, soft, np.minimum(u, top))
    return np.clip(u, 0.0, None)


def surface_gain(p, active, position, q):
    """Thrust factor of each rotor (4, B) near the floor and the ceiling; 1 where neither acts."""
    sides = [s for s in ("ground", "ceiling") if active(s + "_image", s + "_exp", s + "_inverse")]
    if not sides:
        return 1.0
    gain = 1.0
    tilt_x = 2 * (q[1] * q[3] - q[0] * q[2])  # world z of the body x axis
    tilt_y = 2 * (q[2] * q[3] + q[0] * q[1])
    height = position[2] + ROTOR_X[:, None] * tilt_x + ROTOR_Y[:, None] * tilt_y
    for side in sides:
        distance = height if side == "ground" else CEILING - height
        d = np.maximum(distance, 0.0) + p[side + "_offset"]
        # Cheeseman-Bennett 1 / (1 - (R / 4 z)^2) with an effective radius; an exponential; the
        # simple (R / z)^2
        ratio = np.minimum((p[side + "_image"] * PROPELLER / (4.0 * d)) ** 2, 0.5)
        gain = (
            gain + (1.0 / (1.0 - ratio) - 1.0) + p[side + "_exp"] * np.exp(-d / p[side + "_scale"])
        )
        gain = gain + p[side + "_inverse"] * (PROPELLER / d) ** 2
    return gain


def wake_force(p, position, other):
    """Vertical force (B,) N, negative, from the rotor wake of the vehicle at `other` (3, B), and
    its gradient (2, B) N/m.
    """
    dx = position[0] - other[0]
    dy = position[1] - other[1]
    dz = other[2] - position[2]
    below = np.where(dz > 0.02, 1.0, 0.0)
    dz = np.maximum(dz, 0.02)
    width = p["wake_width"] + p["wake_spread"] * dz
    r2 = dx * dx + dy * dy
    gauss = np.exp(-0.5 * r2 / width**2) * np.exp(-dz / p["wake_height"])
    # free jet: speed falls with 1 / distance, a top-hat with soft edge
    edge = np.sqrt(r2 + 1e-9)
    jet = (0.15 / (0.15 + dz)) ** 2 / (
        1.0 + np.exp(np.clip((edge - 1.2 * width) / (0.25 * width), -40, 40))
    )
    shape = np.where(p["wake_jet"] > 0, jet, gauss)
    jet_slope = -jet * (1 - np.clip(jet, 0, 1)) / (0.25 * width * edge)
    slope = np.where(p["wake_jet"] > 0, jet_slope, -gauss / width**2)
    return -p["wake"] * below * shape, -p["wake"] * below * slope * np.stack([dx, dy])


def air_forces(p, active, q, velocity, rates, speed, thrust, position, gust):
    """Force (3, B) N and torque (3, B) N m in the body frame from drag, flapping and wind;
    `thrust`, `speed` (4, B).
    """
    vb = rotate_back(q, velocity)
    force = np.zeros_like(vb)
    torque = np.zeros_like(vb)
    if active("drag_xy", "drag_z"):
        force -= np.stack([p["drag_xy"] * vb[0], p["drag_xy"] * vb[1], p["drag_z"] * vb[2]])
    if active("drag_quadratic"):
        norm = np.sqrt((vb * vb).sum(axis=0))
        force -= p["drag_quadratic"] * norm * vb * np.array([1.0, 1.0, 0.6])[:, None]
    if active("drag_rotor"):
        # in-plane force at each hub, proportional to rotor speed and the hub's own velocity
        c = p["drag_rotor"] * speed / MAX_SPEED
        x = ROTOR_X[:, None]
        y = ROTOR_Y[:, None]
        fx = -c * (vb[0] - rates[2] * y)
        fy = -c * (vb[1] + rates[2] * x)
        fz = -0.5 * c * (vb[2] + rates[0] * y - rates[1] * x)
        force += np.stack([fx.sum(0), fy.sum(0), fz.sum(0)])
        torque += np.stack([(y * fz).sum(0), -(x * fz).sum(0), (x * fy - y * fx).sum(0)])
    if active("drag_height"):
        torque += np.stack(
            [-p["drag_height"] * force[1], p["drag_height"] * force[0], np.zeros(vb.shape[1])]
        )
    if active("flap_torque", "flap_tilt"):
        total = thrust.sum(axis=0)
        advance = np.sqrt(vb[0] ** 2 + vb[1] ** 2) / (
            np.maximum(speed.mean(axis=0), 200.0) * PROPELLER
        )
        grow = 1.0 / (1.0 - 0.5 * np.minimum(advance * p["flap_advance"], 1.0) ** 2)
        lean = p["flap_tilt"] * grow * total
        bend = p["flap_torque"] * grow * total / (p["mass"] * GRAVITY)
        force -= np.stack([lean * vb[0], lean * vb[1], np.zeros(vb.shape[1])])
        # the disk tilts back: the torque is along v x e3 = (v_y, -v_x, 0)
        torque += np.stack([bend * vb[1], -bend * vb[0], np.zeros(vb.shape[1])])
    if active("wind_drag", "wind_quadratic"):
        wind = p["wind"] * (1.0 + p["wind_shear"] * (position[2] - 0.6) + p["wind_gust"] * gust)
        relative = rotate_back(q, wind - velocity)
        norm = np.sqrt((relative * relative).sum(axis=0))
        force += (p["wind_drag"] + p["wind_quadratic"] * norm) * relative
    return force, torque


def seen_by_accelerometer(p, specific, rates):
    """Specific force (3, B) where the accelerometer sits, if that isn't the centre of mass
    (centripetal part).
    """
    lever = -p["com"] * p["imu_lever"]
    return specific + cross(rates, cross(rates, lever))


def draw(rng, effect, form=None):
    """A cause of the effect; the size lies within its usual range, the form is drawn unless
    given.
    """
    (low, high), forms = EFFECTS[effect].sizes, EFFECTS[effect].forms
    form = str(rng.choice(forms)) if form is None else form
    size = low * (high / low) ** rng.uniform()
    return {
        "effect": effect,
        "form": form,
        "size": float(size),
        "shape": rng.uniform(0, 1, 8).tolist(),
    }


def apply(cause, p, c, arrival=None, rng=None):
    """Write the cause into the parameters of the bodies `c`; the link's effects change `arrival`
    (K, B), in ms.

    Returns the magnitudes in the units of the parameter tables: kg, N s/m, m/s, ms, mm, shares.
    """
    name = cause["effect"]
    form = cause["form"]
    a = float(cause["size"])
    s = np.asarray(cause["shape"])
    sign = 1.0 if s[0] < 0.5 else -1.0
    if name == "mass":
        p["mass"][c] *= 1 + sign * a
        if form == "payload":
            p["inertia"][:, :, c] *= 1 + 0.3 * sign * a
        return {"mass_kg": float(p["mass"][c][0]), "ratio": 1 + sign * a}
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
        # size: how much of the room between hover and 0.92 is missing
        top = 0.92 - a * (0.88 - p["hover"][c])
        p["limit"][c] = top
        p["limit_voltage"][c] = 0.25 if form == "voltage" else 0.0
        p["limit_knee"][c] = 0.015 if form == "soft" else 0.0
        return {"limit": float(top[0])}
    if name == "rotor_drag":
        ratio = 0.3 + 0.6 * s[1]
        values = {"d_xy": a, "d_z": a * ratio}
        if form == "linear":
            p["drag_xy"][c], p["drag_z"][c] = a, a * ratio
        elif form == "quadratic":
            p["drag_xy"][c], p["drag_z"][c], p["drag_quadratic"][c] = 0.5 * a, 0.5 * a, 0.5 * a
            values["d_z"] = a
        elif form == "rotor_speed":
            p["drag_rotor"][c] = a / (
                4 * np.sqrt(p["hover"][c])
            )  # at hover speed the four hubs add up to a
            values["d_z"] = 0.5 * a
        else:
            p["drag_xy"][c], p["drag_z"][c], p["drag_height"][c] = (
                a,
                a * ratio,
                0.002 + 0.003 * s[2],
            )
        return values
    if name == "blade_flapping":
        # size: torque at hover thrust in 1e-4 N m per m/s; the thrust leans by 0.004 to 0.03 rad
        # per m/s
        p["flap_torque"][c], p["flap_tilt"][c] = 1e-4 * a, (0.004 + 0.02 * s[1]) * min(a, 1.3)
        p["flap_advance"][c] = 30.0 if form == "advance_ratio" else 0.0
        return {"torque_N_m_per_m_s": 1e-4 * a, "tilt_rad_per_m_s": float(p["flap_tilt"][c][0])}
    if name == "wind":
        angle = 2 * np.pi * s[1]
        p["wind"][:, c] = (a * np.array([np.cos(angle), np.sin(angle), 0.3 * (s[2] - 0.5)]))[
            :, None
        ]
        drag = (0.008 + 0.010 * s[3]) * min(1.0, max(0.3, a / 0.6))
        p["wind_quadratic" if form == "quadratic" else "wind_drag"][c] = drag
        p["wind_shear"][c] = 0.8 if form == "shear" else 0.0
        p["wind_gust"][c] = 0.3 if form == "gusty" else 0.0
        return {
            "w_x": float(a * np.cos(angle)),
            "w_y": float(a * np.sin(angle)),
            "speed": a,
            "drag": drag,
        }
    if name in ("ground_effect", "ceiling_effect"):
        side = name.split("_")[0]
        offset = 0.01 + 0.02 * s[1]
        p[side + "_offset"][c] = offset
        # size: gain of thrust 5 cm from the surface
        if form == "inverse_square":
            p[side + "_inverse"][c] = a * ((0.05 + offset) / PROPELLER) ** 2
        elif form == "cheeseman_bennett":
            p[side + "_image"][c] = 4 * (0.05 + offset) / PROPELLER * np.sqrt(a / (1 + a))
        else:
            scale = 0.035 + 0.04 * s[2]
            p[side + "_scale"][c] = scale
            p[side + "_exp"][c] = a * np.exp((0.05 + offset) / scale)
        return {"gain_at_5cm": a, "offset": offset}
    if name == "downwash":
        p["wake"][c] = a * 1e-3 * GRAVITY
        p["wake_width"][c], p["wake_spread"][c] = 0.02 * 7.5 ** s[1], 0.12 * s[2]
        p["wake_height"][c] = 0.25 + 0.5 * s[3]
        p["wake_jet"][c] = 1.0 if form == "jet" else 0.0
        return {
            "A_g": a,
            "width_m": float(p["wake_width"][c][0]),
            "height_m": float(p["wake_height"][c][0]),
        }
    if name == "motor_lag":
        up = 1 + a
        down = 1 + a
        if form == "up_down":
            up = 1 + a * (0.5 + 0.4 * s[1])
            down = 1 + a * (1.1 + 0.6 * s[2])
        if form == "brushed":
            # as measured on real ones: several times slower, differently up and down, 5 ms late
            up = 1 + a * (0.75 + 0.1 * s[1])
            down = 1 + a * (1.0 + 0.2 * s[2])
            p["tau_second"][c] = 0.004 + 0.002 * s[3]
        said = {
            "tau_up": float(p["tau_up"][c][0] * up),
            "tau_down": float(p["tau_down"][c][0] * down),
        }
        if form == "second_order":
            p["tau_second"][c] = p["tau_up"][c] * 0.3 * a
            up = down = 1 + 0.7 * a
        p["tau_up"][c] *= up
        p["tau_down"][c] *= down
        return said
    if name == "command_latency":
        ticks = arrival.shape[0]
        for j in np.atleast_1d(c):
            extra = np.full(ticks, a)
            if form == "jitter":
                extra = a * (0.75 + 0.5 * rng.uniform(0, 1, ticks))
            elif form == "spikes":
                extra = a * (0.85 + (rng.uniform(0, 1, ticks) < 0.1) * rng.uniform(0.5, 2.5, ticks))
            arrival[:, j] += np.rint(extra).astype(arrival.dtype)
        return {"delay_ms": a}
    if name == "packet_loss":
        ticks = arrival.shape[0]
        for j in np.atleast_1d(c):
            if form == "independent":
                lost = rng.uniform(0, 1, ticks) < a
            else:  # Gilbert-Elliott: bad spells of some 5 packets, in which nearly all are lost
                stay = 0.8
                enter = (1 - stay) * a / max(0.95 - a, 0.05)
                bad = False
                lost = np.zeros(ticks, bool)
                draws = rng.uniform(0, 1, (ticks, 2))
                for k in range(ticks):
                    bad = draws[k, 0] < stay if bad else draws[k, 0] < enter
                    lost[k] = bad and draws[k, 1] < 0.95
            arrival[lost, j] = 10**8
        return {"probability": a}
    return _apply_body(name, form, a, s, sign, p, c)


def _apply_body(name, form, a, s, sign, p, c):
    """The effects on rotors, inertia, rate loop and pose."""
    if name == "thrust_curve":
        hover = p["hover"][c]
        if form == "quadratic":
            # zero at hover and at a second thrust: the curvature is the cause, not the scale
            p["curve_quadratic"][c], p["curve_root"][c] = sign * a, hover - 0.28 + 0.2 * s[1]
            return {"curvature": sign * a}
        if form == "power":
            p["curve_power"][c] = 1 + sign * min(a, 0.9)
            return {"power": 1 + sign * min(a, 0.9)}
        p["curve_dip"][c] = sign * 0.3 * a
        return {"dip": sign * 0.3 * a}
    if name == "motor_imbalance":
        if form == "all":
            e = 2 * s[1:5] - 1
            e -= e.mean()
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
        factors = 1 + a * (0.6 + 0.4 * s[1:4])
        factors = factors if s[0] < 0.7 else 1 / factors
        if form == "products":
            product = 0.12 * (2 * s[4] - 1) * p["inertia"][0, 0, c]
            p["inertia"][0, 1, c] = p["inertia"][1, 0, c] = product
        for i in range(3):
            p["inertia"][i, i, c] *= factors[i]
        return {"ratio": factors.tolist()}
    if name == "yaw_torque":
        # mostly below the nominal, down to 0.15; sometimes above, up to 2
        factor = 1 - a if s[0] < 0.7 else 1 + a
        p["torque_ratio"][c] *= factor
        return {"ratio": factor}
    if name == "rate_gains":
        factors = (1 + a) ** (2 * s[1:4] - 1)
        factors[0] = (1 + a) if s[0] < 0.5 else 1 / (1 + a)
        for key, factor in zip(("kp", "ki", "kd"), factors, strict=True):
            p[key][:, c] *= factor
        p["d_filter"][c] = 0.004 if form == "filtered_d" else 0.0
        return dict(zip(("kp", "ki", "kd"), factors.tolist(), strict=True))
    if name == "state_latency":
        p["pose_delay"][c] = a
        p["pose_jitter"][c] = 0.2 * a if form == "jitter" else 0.0
        return {"delay_ms": a}
    raise ValueError(f"unknown effect {name!r}")
