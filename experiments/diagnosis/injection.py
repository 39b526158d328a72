"""How a drawn cause is written into the plant's parameters, an effect a function.

A cause is {"effect", "form", "size", "shape"}: `size` is the one number that decides the severity,
`shape` are eight uniform draws that fix everything else (signs, axes, ratios), once per case. The
first form of an effect is close to what any library would write; the others are not.

Each function changes the parameters `p` of the bodies `c` in place and returns the magnitudes in
the units of the parameter tables: kg, N s/m, m/s, ms, mm, shares.
"""

from typing import NamedTuple

import numpy as np

from experiments.diagnosis.vehicle import GRAVITY, PROPELLER

LOST = 10**8
"""Arrival (ms) of a packet that never comes."""


class Cause(NamedTuple):
    """What of a cause decides its parameters; `shape` (8,) uniform draws."""

    form: str
    size: float
    shape: np.ndarray

    @property
    def sign(self) -> float:
        """1 or -1, of effects that act either way."""
        return 1.0 if self.shape[0] < 0.5 else -1.0


def inject(cause, p, c, arrival=None, rng=None):
    """Write the cause into the parameters of the bodies `c`; the link's effects change `arrival`
    (K, B), in ms, by draws of `rng`.

    Returns the magnitudes of the effect.
    """
    name = cause["effect"]
    drawn = Cause(cause["form"], float(cause["size"]), np.asarray(cause["shape"]))
    if name in LINK:
        return LINK[name](drawn, arrival, c, rng)
    if name in SURFACES:
        return surface_effect(drawn, p, c, SURFACES[name])
    return VEHICLE[name](drawn, p, c)


# mass, thrust and battery


def mass(cause, p, c):
    """More or less of it; a payload also turns with the body."""
    change = cause.sign * cause.size
    p["mass"][c] *= 1 + change
    if cause.form == "payload":
        p["inertia"][:, :, c] *= 1 + 0.3 * cause.sign * cause.size
    return {"mass_kg": float(p["mass"][c][0]), "ratio": 1 + change}


def thrust_scale(cause, p, c):
    """All rotors push more or less, with or without their reaction torque."""
    change = cause.sign * cause.size
    p["rotor_gain"][:, c] *= 1 + change
    if cause.form == "thrust_only":
        p["torque_gain"][c] /= 1 + change
    return {"scale": change}


def battery_sag(cause, p, c):
    """Thrust falls with the voltage, by several laws."""
    reference = 3.6 + 0.25 * cause.shape[1]
    p["sag_reference"][c] = reference
    if cause.form in ("linear", "power"):
        p["sag_power"][c] = cause.size * (reference if cause.form == "linear" else 3.7)
    else:
        p["sag_quadratic" if cause.form == "quadratic" else "sag_load"][c] = cause.size
    return {"thrust_per_volt": cause.size, "reference_voltage": reference}


def thrust_saturation(cause, p, c):
    """A ceiling of the demand; the size is how much of the room between hover and .92 is missing."""
    top = 0.92 - cause.size * (0.88 - p["hover"][c])
    p["limit"][c] = top
    p["limit_voltage"][c] = 0.25 if cause.form == "voltage" else 0.0
    p["limit_knee"][c] = 0.015 if cause.form == "soft" else 0.0
    return {"limit": float(top[0])}


def thrust_curve(cause, p, c):
    """The map from command to thrust bends."""
    if cause.form == "quadratic":
        # zero at hover and at a second thrust: the curvature is the cause, not the scale
        p["curve_quadratic"][c] = cause.sign * cause.size
        p["curve_root"][c] = p["hover"][c] - 0.28 + 0.2 * cause.shape[1]
        return {"curvature": cause.sign * cause.size}
    if cause.form == "power":
        power = 1 + cause.sign * min(cause.size, 0.9)
        p["curve_power"][c] = power
        return {"power": power}
    dip = cause.sign * 0.3 * cause.size
    p["curve_dip"][c] = dip
    return {"dip": dip}


# air


def rotor_drag(cause, p, c):
    """Force against the velocity, by several laws; the size is its level coefficient."""
    a = cause.size
    ratio = 0.3 + 0.6 * cause.shape[1]
    values = {"d_xy": a, "d_z": a * ratio}
    if cause.form == "linear":
        p["drag_xy"][c] = a
        p["drag_z"][c] = a * ratio
    elif cause.form == "quadratic":
        for name in ("drag_xy", "drag_z", "drag_quadratic"):
            p[name][c] = 0.5 * a
        values["d_z"] = a
    elif cause.form == "rotor_speed":
        # at hover speed the four hubs add up to the size
        p["drag_rotor"][c] = a / (4 * np.sqrt(p["hover"][c]))
        # beside what a real vehicle drags anyway, which the other forms replace
        values["d_xy"] = a + float(np.mean(p["drag_xy"][c]))
        values["d_z"] = 0.5 * a + float(np.mean(p["drag_z"][c]))
    else:
        p["drag_xy"][c] = a
        p["drag_z"][c] = a * ratio
        p["drag_height"][c] = 0.002 + 0.003 * cause.shape[2]
    return values


def blade_flapping(cause, p, c):
    """The size is the torque at hover thrust in 1e-4 N m per m/s; the thrust leans by .004 to .03
    rad per m/s.
    """
    p["flap_torque"][c] = 1e-4 * cause.size
    p["flap_tilt"][c] = (0.004 + 0.02 * cause.shape[1]) * min(cause.size, 1.3)
    p["flap_advance"][c] = 30.0 if cause.form == "advance_ratio" else 0.0
    return {
        "torque_N_m_per_m_s": 1e-4 * cause.size,
        "tilt_rad_per_m_s": float(p["flap_tilt"][c][0]),
    }


def wind(cause, p, c):
    """Air that moves, with a drag by which it pushes; the size is its level speed."""
    speed = cause.size
    angle = 2 * np.pi * cause.shape[1]
    direction = np.array([np.cos(angle), np.sin(angle), 0.3 * (cause.shape[2] - 0.5)])
    p["wind"][:, c] = (speed * direction)[:, None]
    drag = (0.008 + 0.010 * cause.shape[3]) * min(1.0, max(0.3, speed / 0.6))
    p["wind_quadratic" if cause.form == "quadratic" else "wind_drag"][c] = drag
    p["wind_shear"][c] = 0.8 if cause.form == "shear" else 0.0
    p["wind_gust"][c] = 0.3 if cause.form == "gusty" else 0.0
    return {
        "w_x": float(speed * np.cos(angle)),
        "w_y": float(speed * np.sin(angle)),
        "speed": speed,
        "drag": drag,
    }


def surface_effect(cause, p, c, side):
    """Thrust grows near the floor or the ceiling; the size is the gain 5 cm from it."""
    gain = cause.size
    offset = 0.01 + 0.02 * cause.shape[1]
    p[side + "_offset"][c] = offset
    if cause.form == "inverse_square":
        p[side + "_inverse"][c] = gain * ((0.05 + offset) / PROPELLER) ** 2
    elif cause.form == "cheeseman_bennett":
        p[side + "_image"][c] = 4 * (0.05 + offset) / PROPELLER * np.sqrt(gain / (1 + gain))
    else:
        scale = 0.035 + 0.04 * cause.shape[2]
        p[side + "_scale"][c] = scale
        p[side + "_exp"][c] = gain * np.exp((0.05 + offset) / scale)
    return {"gain_at_5cm": gain, "offset": offset}


def downwash(cause, p, c):
    """The wake of a vehicle above; the size is its force in thousandths of the weight of 1 kg."""
    p["wake"][c] = cause.size * 1e-3 * GRAVITY
    p["wake_width"][c] = 0.02 * 7.5 ** cause.shape[1]
    p["wake_spread"][c] = 0.12 * cause.shape[2]
    p["wake_height"][c] = 0.25 + 0.5 * cause.shape[3]
    p["wake_jet"][c] = 1.0 if cause.form == "jet" else 0.0
    return {
        "A_g": cause.size,
        "width_m": float(p["wake_width"][c][0]),
        "height_m": float(p["wake_height"][c][0]),
    }


# rotors, inertia, rate loop


def motor_lag(cause, p, c):
    """Motors that follow more slowly, alike or differently up and down."""
    a = cause.size
    up = 1 + a
    down = 1 + a
    if cause.form == "up_down":
        up = 1 + a * (0.5 + 0.4 * cause.shape[1])
        down = 1 + a * (1.1 + 0.6 * cause.shape[2])
    if cause.form == "brushed":
        # as measured on real ones: several times slower, differently up and down, 5 ms late
        up = 1 + a * (0.75 + 0.1 * cause.shape[1])
        down = 1 + a * (1.0 + 0.2 * cause.shape[2])
        p["tau_second"][c] = 0.004 + 0.002 * cause.shape[3]
    magnitudes = {
        "tau_up": float(p["tau_up"][c][0] * up),
        "tau_down": float(p["tau_down"][c][0] * down),
    }
    if cause.form == "second_order":
        p["tau_second"][c] = p["tau_up"][c] * 0.3 * a
        up = down = 1 + 0.7 * a
    p["tau_up"][c] *= up
    p["tau_down"][c] *= down
    return magnitudes


def motor_imbalance(cause, p, c):
    """Rotors that differ: all of them around their mean, or one that is weaker."""
    if cause.form == "all":
        errors = 2 * cause.shape[1:5] - 1
        errors -= errors.mean()
        errors = cause.size * errors / np.abs(errors).max()
    else:
        errors = np.zeros(4)
        errors[int(4 * cause.shape[1])] = -cause.size
    p["rotor_gain"][:, c] *= (1 + errors)[:, None]
    return {"e": errors.tolist()}


def com_offset(cause, p, c):
    """The centre of mass beside the rotors' middle, by so many mm."""
    angle = 2 * np.pi * cause.shape[1]
    offset = cause.size * 1e-3 * np.array([np.cos(angle), np.sin(angle), 0.0])
    p["com"][:, c] = offset[:, None]
    p["imu_lever"][c] = 1.0 if cause.form == "full" else 0.0
    return {"x_mm": float(1e3 * offset[0]), "y_mm": float(1e3 * offset[1])}


def inertia(cause, p, c):
    """Moments of inertia of their own, mostly larger; or with a product between x and y."""
    factors = 1 + cause.size * (0.6 + 0.4 * cause.shape[1:4])
    factors = factors if cause.shape[0] < 0.7 else 1 / factors
    if cause.form == "products":
        product = 0.12 * (2 * cause.shape[4] - 1) * p["inertia"][0, 0, c]
        p["inertia"][0, 1, c] = p["inertia"][1, 0, c] = product
    for i in range(3):
        p["inertia"][i, i, c] *= factors[i]
    return {"ratio": factors.tolist()}


def yaw_torque(cause, p, c):
    """The rotors' reaction: mostly below the nominal, down to .15; sometimes above, up to 2."""
    factor = 1 - cause.size if cause.shape[0] < 0.7 else 1 + cause.size
    p["torque_ratio"][c] *= factor
    return {"ratio": factor}


def rate_gains(cause, p, c):
    """Gains of the rate loop that somebody retuned."""
    factors = (1 + cause.size) ** (2 * cause.shape[1:4] - 1)
    factors[0] = (1 + cause.size) if cause.shape[0] < 0.5 else 1 / (1 + cause.size)
    for key, factor in zip(("kp", "ki", "kd"), factors, strict=True):
        p[key][:, c] *= factor
    p["d_filter"][c] = 0.004 if cause.form == "filtered_d" else 0.0
    return dict(zip(("kp", "ki", "kd"), factors.tolist(), strict=True))


# time


def state_latency(cause, p, c):
    """Poses that come later."""
    p["pose_delay"][c] = cause.size
    p["pose_jitter"][c] = 0.2 * cause.size if cause.form == "jitter" else 0.0
    return {"delay_ms": cause.size}


def command_latency(cause, arrival, c, rng):
    """Commands that arrive later, evenly or not."""
    a = cause.size
    ticks = arrival.shape[0]
    for j in np.atleast_1d(c):
        extra = np.full(ticks, a)
        if cause.form == "jitter":
            extra = a * (0.75 + 0.5 * rng.uniform(0, 1, ticks))
        elif cause.form == "spikes":
            extra = a * (0.85 + (rng.uniform(0, 1, ticks) < 0.1) * rng.uniform(0.5, 2.5, ticks))
        arrival[:, j] += np.rint(extra).astype(arrival.dtype)
    return {"delay_ms": a}


def packet_loss(cause, arrival, c, rng):
    """Commands that never arrive, one by one or in bursts; the size is their share."""
    ticks = arrival.shape[0]
    for j in np.atleast_1d(c):
        if cause.form == "independent":
            lost = rng.uniform(0, 1, ticks) < cause.size
        else:
            lost = bursts(cause.size, rng.uniform(0, 1, (ticks, 2)))
        arrival[lost, j] = LOST
    return {"probability": cause.size}


def bursts(share, draws):
    """Which packets a Gilbert-Elliott link loses, from two uniform draws a packet: bad spells last
    some 5 packets, in which nearly all are lost.
    """
    stay = 0.8
    enter = (1 - stay) * share / max(0.95 - share, 0.05)
    bad = False
    lost = np.zeros(len(draws), bool)
    for k, (change, loss) in enumerate(draws):
        bad = change < stay if bad else change < enter
        lost[k] = bad and loss < 0.95
    return lost


LINK = {"command_latency": command_latency, "packet_loss": packet_loss}
SURFACES = {"ground_effect": "ground", "ceiling_effect": "ceiling"}
VEHICLE = {
    function.__name__: function
    for function in (
        *(mass, thrust_scale, battery_sag, thrust_saturation, thrust_curve),
        *(rotor_drag, blade_flapping, wind, downwash),
        *(motor_lag, motor_imbalance, com_offset, inertia, yaw_torque, rate_gains),
        state_latency,
    )
}
