"""How the effects act inside the plant: motors' demand, thrust near surfaces, wakes, and the forces
of the air.

What acts is decided by the plant's parameters alone (`vehicle.nominal_parameters`, with causes
written in by `injection`). Arrays have the body index last.
"""

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
        # Cheeseman-Bennett 1 / (1 - (R / 4 z)^2) with an effective radius; an
        # exponential; the simple (R / z)^2
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
