"""Numbers of the vehicle's forces by prediction errors: thrust, its dependence on the
battery, and drag along the body's axes.

Linear in the numbers once the rotors' lag is known, with a constant for every flight
(the accelerometer's offset, a tilt) and noise of an autoregression, fitted in turn
(Cochrane, Orcutt 1949; Ljung, System Identification, chapter 7).
"""

import numpy as np
from scipy.signal import lfilter

from openjax.flights.track import specific_force_of, to_body
from openjax.gap.identification.records import Record
from openjax.gap.identification.regression import solve
from openjax.gap.identification.rotor_rows import rotor_rows

ORDER = 12  # rows of the noise's autoregression
ROUNDS = 4
BLOCK = 1.0  # s over which errors may hang together
FORM = {"thrust_level": 0.01, "thrust_slope": 0.03}
"""Relative errors of accelerometers' scale and of straight lines through a rotor's
map.
"""
Numbers = dict[str, tuple[float, float]]


def identify_forces(records: list[Record], lags: np.ndarray) -> Numbers:
    """{name: (value, standard deviation)}: `thrust_level` and `thrust_slope` over the
    nominal, `sag` (share of thrust per V), `drag_xy` and `drag_z` (N s/m); only what
    the records hold. `lags` (3,): spin-up, spin-down and delay, s.
    """
    known = [r for r in records if _force(r) is not None]
    if not known:
        return {}
    vehicle = known[0].vehicle
    mass = float(vehicle.mass)
    full = 4.0 * float(vehicle.thrust_constant * vehicle.max_rotor_speed**2) / mass
    thrusts = [full * t for t in _thrusts(known, lags)]
    forces = [_force(r) for r in known]
    level = np.array(
        [f[:, 2].mean() / t.mean() for f, t in zip(forces, thrusts, strict=True)]
    )
    spread = level.std() / np.sqrt(len(level))
    found = {"thrust_level": (float(level.mean()), float(spread))}
    columns = {"thrust_slope": thrusts}
    if all(r.voltage is not None for r in known):
        middle = np.median(np.concatenate([r.voltage for r in known]))
        columns["sag"] = [
            (r.voltage - middle) * t for r, t in zip(known, thrusts, strict=True)
        ]
    moving = all(r.velocity is not None and r.quaternion is not None for r in known)
    if moving:
        speeds = [to_body(r.quaternion, r.velocity) for r in known]
        columns["drag_z"] = [-s[:, 2] / mass for s in speeds]
    dt = known[0].dt
    found |= _regression([f[:, 2] for f in forces], columns, dt)
    if moving:
        sides = [f[:, axis] for f in forces for axis in (0, 1)]
        drag = {"drag_xy": [-s[:, axis] / mass for s in speeds for axis in (0, 1)]}
        found |= _regression(sides, drag, dt)
    return {
        name: (value, float(np.hypot(error, FORM.get(name, 0.0) * abs(value))))
        for name, (value, error) in found.items()
    }


def trims(records: list[Record]) -> Numbers:
    """{axis: (share of the mean thrust that motors hold against, its standard deviation
    over flights)}: what keeps the vehicle from turning by itself.
    """
    x, y = np.asarray(records[0].vehicle.rotor_position, float)[:, :2].T
    spin = np.asarray(records[0].vehicle.rotor_spin, float)
    signs = np.sign(np.stack([y, -x, spin]))
    held = np.array(
        [(r.motor @ signs.T).mean(0) / r.motor.sum(1).mean() for r in records]
    )
    error = held.std(0) / np.sqrt(len(held))
    return {
        f"{axis}_trim": (float(v), float(e))
        for axis, v, e in zip(
            ("roll", "pitch", "yaw"), held.mean(0), error, strict=True
        )
    }


def _force(record: Record) -> np.ndarray | None:
    if record.force is not None:
        return record.force
    if record.velocity is None or record.quaternion is None:
        return None
    return specific_force_of(record.quaternion, record.velocity, record.dt)


def _thrusts(records: list[Record], lags: np.ndarray) -> list[np.ndarray]:
    """(T,) thrust at each row's time, as a share of the largest, of each record."""
    rotors = rotor_rows(
        [r.motor for r in records], records[0].dt, np.asarray(lags, float)[None]
    )
    return [(np.concatenate([s[0, :1], s[0, :-1]]) ** 2).mean(1) for _, s in rotors]


def _regression(outputs: list, columns: dict[str, list], dt: float) -> Numbers:
    """Coefficients of named columns with standard deviations."""
    names = list(columns)
    noise = np.array([1.0])
    for _ in range(ROUNDS):
        pasts = []
        nexts = []
        for number, y in enumerate(outputs):
            ones = np.zeros((len(y), len(outputs)))
            ones[:, number] = 1.0
            parts = np.column_stack([*(columns[n][number] for n in names), ones])
            pasts.append(lfilter(noise, [1.0], parts, axis=0)[ORDER:])
            nexts.append(lfilter(noise, [1.0], y)[ORDER:])
        past = np.concatenate(pasts)
        following = np.concatenate(nexts)
        taken = solve(past, following)
        errors = following - past @ taken
        noise = _autoregression(outputs, [columns[n] for n in names], taken)
    inverse = np.linalg.pinv(past.T @ past)
    pieces = np.arange(0, len(errors), max(int(BLOCK / dt), 1))
    sums = np.add.reduceat(past * errors[:, None], pieces, 0)
    covariance = inverse @ (sums.T @ sums) @ inverse
    return {
        n: (float(taken[i]), float(np.sqrt(max(covariance[i, i], 0.0))))
        for i, n in enumerate(names)
    }


def _autoregression(outputs: list, columns: list, taken: np.ndarray) -> np.ndarray:
    """1 - a_1 q^-1 - ... of what coefficients leave of the outputs."""
    pasts = []
    nexts = []
    for number, y in enumerate(outputs):
        left = y - sum(
            c * column[number] for c, column in zip(taken, columns, strict=False)
        )
        left = left - left.mean()
        rows = np.arange(ORDER, len(left))
        pasts.append(left[rows[:, None] - 1 - np.arange(ORDER)])
        nexts.append(left[ORDER:])
    return np.concatenate([[1.0], -solve(np.concatenate(pasts), np.concatenate(nexts))])
