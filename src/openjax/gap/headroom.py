"""What a flexible model could still explain: forces and torques that depend on the state in many plausible
ways, without any effect's form.

Each column of the dictionary is a force or torque along one axis that follows one variable of the log. It goes
through the same replay, noise models and nuisances as the effects do, after the parameters of the accepted set
are projected out, so its gain is in the same nats. The noise models of the scores were made with the library's
own effects at work; what the library lacks has made them louder. So the look is taken a second time with noise
models that suit the rest once the dictionary is taken off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from openjax.flights.track import Track, rotation, smooth
from openjax.gap.hypotheses import SetFit, noise_of, without_nuisances
from openjax.gap.library import prior
from openjax.gap.replay import FORCE, SKIP, VELOCITY, Replay, torque_channels
from openjax.gap.replay import GROUPS as NOISE_GROUPS
from openjax.vehicle.effects.effect import ARENA_CEILING

GROUPS = ("force_xy", "force_z", "torque_xy", "torque_z")
SPREADS = (0.1, 0.3, 1.0)  # m/s^2 and, times TORQUE, rad/s^2: prior rms of a column's part of the motion
TORQUE = 10.0
PASSES = 2  # of fitting the dictionary and the noise models in turn
RADIUS = 0.023  # m, of a propeller
SMALLEST = 1e-3  # of a variable's usual size: a column with less never happened in these flights


@dataclass(frozen=True, eq=False)
class Headroom:
    """`names` (K,) of the columns, `group` (K,) indices of GROUPS; `push` (2, F, K) and `weight` (2, F, K):
    gradient and curvature of the log-likelihood (nats) in each column alone, by flight, with the scores' noise
    models and with the dictionary's own; `inside` (2, S, G + 1): log Bayes factor of each group (last: all) by
    spread; `power` (2, F): half the rest's whitened sum of squares; `sharper` (6,): nats by which the
    dictionary's noise models beat the rest's own, by group of channels, at equal whitened power."""

    names: tuple[str, ...]
    group: np.ndarray
    push: np.ndarray
    weight: np.ndarray
    inside: np.ndarray
    power: np.ndarray
    sharper: np.ndarray


def look_around(replay: Replay, fit: SetFit) -> Headroom:
    """The headroom above a fitted set."""
    tables = [dictionary(t) for t in replay.tracks]
    shared = [n for n in tables[0] if all(n in t for t in tables)]
    size = {n: np.sqrt(np.mean(np.concatenate([t[n][1] for t in tables]) ** 2)) for n in shared}
    shared = [n for n in shared if size[n] > SMALLEST * tables[0][n][2]]
    group = np.array([GROUPS.index(tables[0][n][0]) for n in shared])
    columns = []
    for number, (track, table) in enumerate(zip(replay.tracks, tables, strict=True)):
        own = fit.columns[number]
        moved = [channels(track, table[n][0], table[n][1] / size[n]) for n in shared]
        columns.append(np.concatenate([own, np.stack(moved)]))
    before = replay.noises, replay.whitened_nuisances
    alone = noise_of(replay, [without_nuisances(replay, c[0], k) for k, c in enumerate(columns)])
    looks = [_one_look(replay, columns, fit, group)]
    own = len(fit.index)
    penalty = np.zeros((own + len(group), own + len(group)))
    penalty[:own, :own] = prior(fit.effects)[2]
    penalty[np.arange(own, len(penalty)), np.arange(own, len(penalty))] = (
        1.0 / _deviation(group, SPREADS[-1]) ** 2
    )
    for _ in range(PASSES):
        gram = replay.grams(columns).sum(0)
        weights = np.linalg.solve(gram[1:, 1:] + penalty, gram[1:, 0])
        left = [c[0] - np.tensordot(weights, c[1:], 1) for c in columns]
        replay.set_noise(noise_of(replay, [without_nuisances(replay, r, k) for k, r in enumerate(left)]))
    looks.append(_one_look(replay, columns, fit, group))
    rows = sum(len(t) - int(SKIP / t.dt) for t in replay.tracks)
    sharper = [
        len(axes) * rows * np.log(old.deviation / new.deviation)
        for (axes, _), old, new in zip(NOISE_GROUPS, alone, replay.noises, strict=True)
    ]
    replay.noises, replay.whitened_nuisances = before
    return Headroom(
        tuple(shared), group, *(np.array(values) for values in zip(*looks, strict=True)), np.array(sharper)
    )


def _deviation(group: np.ndarray, spread: float) -> np.ndarray:
    """Prior standard deviations (K,) of the columns."""
    return spread * np.where(group >= 2, TORQUE, 1.0)


def _one_look(replay: Replay, columns, fit: SetFit, group: np.ndarray):
    """push (F, K), weight (F, K), inside (S, G + 1) and power (F,) with the present noise models."""
    grams = _without_own(replay.grams(columns), fit)
    rest, push, curvature = grams[:, 0, 0], grams[:, 1:, 0], grams[:, 1:, 1:]
    picks = [group == k for k in range(len(GROUPS))] + [np.ones(len(group), bool)]
    inside = np.zeros((len(SPREADS), len(picks)))
    a, b = curvature.sum(0), push.sum(0)
    for s, spread in enumerate(SPREADS):
        precision = 1.0 / _deviation(group, spread) ** 2
        for p, pick in enumerate(picks):
            hessian = a[np.ix_(pick, pick)] + np.diag(precision[pick])
            volume = np.linalg.slogdet(hessian)[1] - np.log(precision[pick]).sum()
            inside[s, p] = 0.5 * b[pick] @ np.linalg.solve(hessian, b[pick]) - 0.5 * volume
    return push, np.diagonal(curvature, axis1=1, axis2=2), inside, 0.5 * rest


def _without_own(grams: np.ndarray, fit: SetFit) -> np.ndarray:
    """Grams (F, 1 + K, 1 + K) of the rest and the dictionary once the set's own parameters are refitted to all
    flights along with anything (they are common to the flights, so their part is taken by the total)."""
    own = len(fit.index)
    if not own:
        return grams
    _, _, precision = prior(fit.effects)
    total = grams.sum(0)
    keep = [0, *range(1 + own, grams.shape[1])]
    inner = total[1 : 1 + own, 1 : 1 + own] + precision
    taken = np.linalg.solve(inner, total[1 : 1 + own][:, keep])  # (own, 1 + K)
    lift = np.zeros((grams.shape[1], len(keep)))
    lift[keep, np.arange(len(keep))] = 1.0
    lift[1 : 1 + own] = -taken
    return np.einsum("ia,fij,jb->fab", lift, grams, lift)


def channels(track: Track, group: str, values: np.ndarray) -> np.ndarray:
    """Channels (T, 9) of an acceleration (T, 3) of the body frame: linear (m/s^2) or angular (rad/s^2)."""
    if group.startswith("torque"):
        return torque_channels(values, track.dt)
    out = np.zeros((len(track), 9))
    turn = rotation(track.quaternion) if track.quaternion is not None else np.eye(3)[None]
    out[1:, VELOCITY] = (
        np.cumsum(np.einsum("tij,tj->ti", turn, values) if len(turn) > 1 else values, 0)[:-1] * track.dt
    )
    out[:, FORCE] = values
    return out


def dictionary(track: Track) -> dict[str, tuple[str, np.ndarray, float]]:
    """{name: (group, acceleration (T, 3) of the body frame, usual size)}."""
    rows = len(track)
    zero, one = np.zeros(rows), np.ones(rows)
    turn = rotation(track.quaternion) if track.quaternion is not None else np.tile(np.eye(3), (rows, 1, 1))
    velocity = track.velocity if track.velocity is not None else np.zeros((rows, 3))
    v = np.einsum("tji,tj->ti", turn, velocity)
    speed = np.linalg.norm(v, axis=1)
    w = smooth(track.body_rates, 0.05, track.dt)
    force = smooth(track.motor.mean(1), 0.05, track.dt)
    over = force - 0.62
    mix = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]]) / 4.0
    roll, pitch, yaw = smooth(track.motor @ mix.T, 0.03, track.dt).T
    square = smooth((track.motor - 0.62) ** 2 @ mix.T, 0.03, track.dt).T
    clipped = smooth(np.maximum(track.motor - 0.75, 0.0) @ mix.T, 0.03, track.dt).T
    slope = lambda x: np.gradient(x, track.dt)  # noqa: E731
    tilt = turn[:, 2]  # world's vertical in the body frame
    heading = np.arctan2(turn[:, 1, 0], turn[:, 0, 0])
    time = (track.time - track.time[0]) / 10.0 - 0.5
    out: dict[str, tuple[str, np.ndarray, float]] = {}

    def add(group, name, axis, values, usual=1.0):
        vector = np.zeros((rows, 3))
        if axis is None:
            vector = values
        else:
            vector[:, axis] = values
        out[f"{group} {name}"] = (group, vector, usual)

    for axis, label in ((0, "x"), (1, "y")):
        for name, values in {
            "v": v[:, axis],
            "v|v|": v[:, axis] * speed,
            "F v": v[:, axis] * over,
            "motors": (pitch, roll)[axis],
            "w": w[:, 1 - axis],
            "v other": v[:, 1 - axis],
            "F": force,
        }.items():
            add("force_xy", f"{name} in {label}", axis, values)
    for axis, label in ((0, "x"), (1, "y")):
        add("force_xy", f"world {label}", None, turn[:, axis])
    vertical = {
        "one": one, "v_z": v[:, 2], "v_z|v|": v[:, 2] * speed, "v_xy^2": (v[:, :2] ** 2).sum(1),
        "sink": np.minimum(v[:, 2], 0.0), "F": over, "F^2": over**2, "F^3": over**3,
        "high F": np.maximum(force - 0.75, 0.0), "high motors": np.maximum(track.motor - 0.75, 0.0).mean(1),
        "motors^2": ((track.motor - 0.62) ** 2).mean(1), "highest motor": np.maximum(track.motor.max(1) - 0.8, 0.0),
        "dF/dt": slope(force) / 10.0, "t": time, "t^2": time**2, "|yaw|": np.abs(yaw),
        "tilt^2": 1.0 - tilt[:, 2], "w^2": (w[:, :2] ** 2).sum(1) / 10.0,
    }  # fmt: skip
    if track.voltage is not None:
        vertical |= {
            "V": track.voltage - 3.7,
            "V F": (track.voltage - 3.7) * force,
            "V^2": (track.voltage - 3.7) ** 2,
        }
    lateral = {
        "one": (one, one), "F": (force, force), "v": (v[:, 1], v[:, 0]), "v same": (v[:, 0], v[:, 1]),
        "F v": (v[:, 1] * over, v[:, 0] * over), "w": (w[:, 0], w[:, 1]), "w other": (w[:, 1], w[:, 0]),
        "motors": (roll, pitch), "motors other": (pitch, roll), "F motors": (roll * over, pitch * over),
        "d motors": (slope(roll) / 10, slope(pitch) / 10), "t": (time, time), "F^2": (force**2, force**2),
        "v_z": (v[:, 2], v[:, 2]), "tilt": (tilt[:, 1], tilt[:, 0]), "motors |motors|": (roll * abs(roll), pitch * abs(pitch)),
        "yaw motors": (yaw, yaw), "motors^2": (square[0], square[1]), "high motors": (clipped[0], clipped[1]),
    }  # fmt: skip
    around = {
        "one": one, "F": force, "F^2": force**2, "w_z": w[:, 2], "w_x": w[:, 0], "w_y": w[:, 1], "motors": yaw,
        "F motors": yaw * over, "d motors": slope(yaw) / 10.0, "roll motors": roll, "pitch motors": pitch,
        "dF/dt": slope(force) / 10.0, "t": time, "v_x": v[:, 0], "v_y": v[:, 1],
        "sin heading": np.sin(heading), "cos heading": np.cos(heading), "w_x w_y": w[:, 0] * w[:, 1],
        "motors |motors|": yaw * np.abs(yaw), "motors^2": square[2], "high motors": clipped[2],
    }  # fmt: skip
    if track.position is not None:
        p, z = track.position, track.position[:, 2]
        up, down = np.maximum(z, 0.0), np.maximum(ARENA_CEILING - z, 0.0)
        floors = {"floor 1/z^2": (RADIUS / (up + 0.015)) ** 2, "floor exp": np.exp(-up / 0.05)}
        roofs = {"ceiling 1/z^2": (RADIUS / (down + 0.02)) ** 2, "ceiling exp": np.exp(-down / 0.05)}
        vertical |= floors | roofs | {"z": z - 0.6, "floor wide": np.exp(-up / 0.12)}
        for name, values in (("floor", floors["floor exp"]), ("ceiling", roofs["ceiling exp"])):
            lateral[f"{name} tilt"] = (values * tilt[:, 1], values * tilt[:, 0])
        radius = np.hypot(p[:, 0], p[:, 1]) + 1e-6
        outward = np.stack([p[:, 0] / radius, p[:, 1] / radius, zero], 1)
        for name, values in (
            ("wall", np.exp(-np.maximum(0.75 - radius, 0.0) / 0.2)[:, None] * outward),
            ("place", p - np.array([0.0, 0.0, 0.6])),
            ("far", np.maximum(radius - 0.4, 0.0)[:, None] * outward),
        ):
            add("force_xy", name, None, np.einsum("tji,tj->ti", turn, values))
        for axis, label in ((0, "x"), (1, "y")):
            add("force_xy", f"world {label} z", None, turn[:, axis] * (z - 0.6)[:, None])
        under, near = [], []
        for width in (0.05, 0.09, 0.15):
            total, lean = zero.copy(), np.zeros((rows, 3))
            for other in track.neighbours:
                gap = other - p
                part = (gap[:, 2] > 0.02) * np.exp(-gap[:, 2] / 0.5)
                part = part * np.exp(-(gap[:, 0] ** 2 + gap[:, 1] ** 2) / (2 * width**2))
                total += part
                lean += part[:, None] * gap * [1, 1, 0] / width
            under.append(total)
            near.append(np.einsum("tji,tj->ti", turn, lean))
        vertical |= {"under narrow": under[0], "under": under[1], "under wide": under[2]}
        lateral["under"] = (near[0][:, 1], near[0][:, 0])
        around["under"] = under[1]
    for name, values in vertical.items():
        add("force_z", name, 2, values)
    for name, both in lateral.items():
        for axis, label in ((0, "x"), (1, "y")):
            add("torque_xy", f"{name} in {label}", axis, both[axis])
    for name, values in around.items():
        add("torque_z", name, 2, values)
    return out
