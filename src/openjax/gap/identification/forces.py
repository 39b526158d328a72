"""Numbers of the vehicle's forces by prediction errors: thrust, its dependence on the
battery, and drag along the body's axes.

Linear in the numbers once the rotors' lag is known, with a constant for every flight
(the accelerometer's offset, a tilt) and noise of an autoregression, fitted in turn
(Cochrane, Orcutt 1949; Ljung, System Identification, chapter 7).
"""

import numpy as np
from scipy.signal import lfilter

from openjax.flights.track import Track, specific_force_of, to_body
from openjax.gap.identification.regression import solve
from openjax.gap.identification.rotor_rows import rotor_rows
from openjax.gap.identification.search import BLOCK

ORDER = 12  # rows of the noise's autoregression
ROUNDS = 4
FORM = {"thrust_level": 0.01, "thrust_slope": 0.03}
"""Relative errors of accelerometers' scale and of straight lines through a rotor's
map.
"""
Numbers = dict[str, tuple[float, float]]


def identify_forces(records: list[Track], lags: np.ndarray) -> Numbers:
    """{name: (value, standard deviation)}: `thrust_level` and `thrust_slope` over the
    nominal, `sag` (share of thrust per V), `drag_xy` and `drag_z` (N s/m); only what
    the records hold. `lags` (3,): spin-up, spin-down and delay, s.
    """
    with_force = [r for r in records if _force(r) is not None]
    if not with_force:
        return {}
    vehicle = with_force[0].vehicle
    mass = float(vehicle.mass)
    full = 4.0 * float(vehicle.thrust_constant * vehicle.max_rotor_speed**2) / mass
    thrusts = [full * t for t in _thrusts(with_force, lags)]
    forces = [_force(r) for r in with_force]
    level = np.array([f[:, 2].mean() / t.mean() for f, t in zip(forces, thrusts, strict=True)])
    spread = level.std() / np.sqrt(len(level))
    numbers = {"thrust_level": (float(level.mean()), float(spread))}
    columns = {"thrust_slope": thrusts}
    if all(r.voltage is not None for r in with_force):
        middle = np.median(np.concatenate([r.voltage for r in with_force]))
        columns["sag"] = [
            (r.voltage - middle) * t for r, t in zip(with_force, thrusts, strict=True)
        ]
    moving = all(r.velocity is not None and r.quaternion is not None for r in with_force)
    if moving:
        speeds = [to_body(r.quaternion, r.velocity) for r in with_force]
        columns["drag_z"] = [-s[:, 2] / mass for s in speeds]
    dt = with_force[0].dt
    numbers |= _regression([f[:, 2] for f in forces], columns, dt)
    if moving:
        sides = [f[:, axis] for f in forces for axis in (0, 1)]
        drag = {"drag_xy": [-s[:, axis] / mass for s in speeds for axis in (0, 1)]}
        numbers |= _regression(sides, drag, dt)
    return {
        name: (value, float(np.hypot(error, FORM.get(name, 0.0) * abs(value))))
        for name, (value, error) in numbers.items()
    }


def trims(records: list[Track]) -> Numbers:
    """{axis: (share of the mean thrust that motors hold against, its standard deviation
    over flights)}: what keeps the vehicle from turning by itself.
    """
    x, y = np.asarray(records[0].vehicle.rotor_position, float)[:, :2].T
    spin = np.asarray(records[0].vehicle.rotor_spin, float)
    signs = np.sign(np.stack([y, -x, spin]))
    shares = np.array([(r.motor @ signs.T).mean(0) / r.motor.sum(1).mean() for r in records])
    error = shares.std(0) / np.sqrt(len(shares))
    return {
        f"{axis}_trim": (float(v), float(e))
        for axis, v, e in zip(("roll", "pitch", "yaw"), shares.mean(0), error, strict=True)
    }


def _force(record: Track) -> np.ndarray | None:
    if record.specific_force is not None:
        return record.specific_force
    if record.velocity is None or record.quaternion is None:
        return None
    return specific_force_of(record.quaternion, record.velocity, record.dt)


def _thrusts(records: list[Track], lags: np.ndarray) -> list[np.ndarray]:
    """(T,) thrust at each row's time, as a share of the largest, of each record."""
    rotors = rotor_rows([r.motor for r in records], records[0].dt, np.asarray(lags, float)[None])
    # a row's speed is the one at its end, where the next row begins
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
        coefficients = solve(past, following)
        errors = following - past @ coefficients
        noise = _autoregression(outputs, [columns[n] for n in names], coefficients)
    inverse = np.linalg.pinv(past.T @ past)
    pieces = np.arange(0, len(errors), max(int(BLOCK / dt), 1))
    sums = np.add.reduceat(past * errors[:, None], pieces, 0)
    covariance = inverse @ (sums.T @ sums) @ inverse
    return {
        n: (float(coefficients[i]), float(np.sqrt(max(covariance[i, i], 0.0))))
        for i, n in enumerate(names)
    }


def _autoregression(outputs: list, columns: list, coefficients: np.ndarray) -> np.ndarray:
    """1 - a_1 q^-1 - ... of what coefficients leave of the outputs."""
    pasts = []
    nexts = []
    for number, y in enumerate(outputs):
        rest = y - sum(c * column[number] for c, column in zip(coefficients, columns, strict=False))
        rest = rest - rest.mean()
        rows = np.arange(ORDER, len(rest))
        pasts.append(rest[rows[:, None] - 1 - np.arange(ORDER)])
        nexts.append(rest[ORDER:])
    return np.concatenate([[1.0], -solve(np.concatenate(pasts), np.concatenate(nexts))])
