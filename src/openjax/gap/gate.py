"""Signs that something acts which the library doesn't hold: numbers about what a set of effects leaves, which the
decision weighs.

None of them knows the effects: the rest's power by band, what a flexible model still finds in it, what the
nuisances had to take, how the flights agree, and what the other paths ask for in vain. They are compared with
flights on which nothing acts (`Null`)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from openjax.gap.headroom import TORQUE, Headroom

COLUMN_SPREAD = 0.3  # prior rms of a dictionary column alone: m/s^2, and times TORQUE rad/s^2
USUAL_GAIN = 5.0  # nats added to what a column gains on nominal flights before ratios are taken
FIRMNESS = 30.0  # nats of the dictionary's log Bayes factor per unit of its features
NAMED_NUISANCES = 21  # the first so many: the vehicle's numbers, sensors and clocks
FREE = 1.0  # usual sizes that a nuisance may take before it counts


@dataclass(frozen=True)
class Null:
    """What nominal flights of the tuning plant show: mean and deviation of each number of `Rest.vector`, the gain of
    each dictionary column (nats, 0.9 quantile, by look), log Bayes factors (mean, by look and group) and sharpness
    (mean, by group of channels)."""

    rest: tuple[float, ...] = ()
    rest_scale: tuple[float, ...] = ()
    columns: dict[str, tuple[float, float]] = field(default_factory=dict)
    inside: tuple[tuple[float, ...], ...] = ()
    sharper: tuple[float, ...] = ()


def column_gains(push: np.ndarray, weight: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Log Bayes factor (2, K) of each dictionary column alone, from push and weight (2, K) over all flights."""
    precision = 1.0 / (COLUMN_SPREAD * np.where(group >= 2, TORQUE, 1.0)) ** 2
    return 0.5 * push**2 / (weight + precision) - 0.5 * np.log1p(weight / precision)


def summary(room: Headroom) -> dict:
    """A headroom as the plain numbers that `features` takes."""
    return {
        "names": list(room.names),
        "group": room.group,
        "push": room.push.sum(1),
        "weight": room.weight.sum(1),
        "inside": room.inside[:, 0],
        "power": room.power.sum(1),
        "sharper": room.sharper,
    }


@dataclass(frozen=True, eq=False)
class Left:
    """What a set of effects leaves: `rest` as `Rest.vector`, `room` as `summary`, `nuisances` (N,) in usual sizes,
    mean over the tracks."""

    rest: np.ndarray
    room: dict
    nuisances: np.ndarray


def features(left: Left, nothing: Left, paths: dict, effects, chosen, null: Null) -> dict[str, float]:
    """The signs, by name: what the chosen set leaves, beside what no effect leaves. paths as `decision.path_scores`,
    effects of the library."""
    bands, before, out = _bands(left, null), _bands(nothing, null), {}
    motion = bands[:12].max()
    rest = np.asarray(left.rest, float)
    z = (rest - np.asarray(null.rest)) / np.asarray(null.rest_scale)
    out |= {
        "motion": motion,
        "motion kept": motion / (before[:12].max() + 0.5),
        "accelerometer": bands[12:].max(),
    }
    out |= {"predicted": rest[18:22].max(), "uneven": np.log1p(max(z[24:28].max(), 0.0))}
    room = left.room
    gains = column_gains(np.asarray(room["push"]), np.asarray(room["weight"]), np.asarray(room["group"]))
    usual = np.array([null.columns.get(n, (20.0, 20.0)) for n in room["names"]]).T
    ratio = np.maximum(gains, 0.0) / (USUAL_GAIN + np.maximum(usual, 0.0))
    inside, whole = (
        np.maximum(np.asarray(r["inside"]) - np.asarray(null.inside), 0.0) / FIRMNESS
        for r in (room, nothing.room)
    )
    for look, name in enumerate(("", "sharp ")):
        out[f"{name}column"] = float(np.log1p(ratio[look].max()))
        out[f"{name}room"] = float(np.log1p(inside[look, -1]))
        total = inside[look, :-1].sum()
        out[f"{name}kept"] = total / (whole[look, :-1].sum() + 1.0)
        out[f"{name}kept much"] = float(np.log1p(total)) * min(out[f"{name}kept"], 1.0)
    sharper = np.maximum(np.asarray(room["sharper"]) - np.asarray(null.sharper), 0.0)
    taken = np.maximum(np.abs(np.asarray(left.nuisances)[:NAMED_NUISANCES]) - FREE, 0.0)
    out |= {
        "sharper motion": float(np.log1p(sharper[:4].sum() / FIRMNESS)),
        "nuisances": float(np.log1p(taken.sum())),
    }
    sets = {k: g for k, g in paths["sets"].items() if set(k) <= set(effects)}
    physics = {e for e in chosen if (e,) in sets}
    gain = max([g for k, g in sets.items() if set(k) == physics], default=0.0)
    out |= {
        "gain": float(np.log1p(max(gain, 0.0))) / 10.0,
        "size": float(len(chosen)),
        "named": float(len(chosen) > 0),
        "flat curve": float("thrust_curve" in chosen and paths.get("flat", False)),
    }
    return {k: float(v) for k, v in out.items()} | _in_vain(paths, effects)


def _bands(left: Left, null: Null) -> np.ndarray:
    """Excess (18,) of the rest's bands over nominal flights: strong against the sensors' noise and strong in itself, so
    that neither other sensors nor noisier ones look strange."""
    z = (np.asarray(left.rest, float) - np.asarray(null.rest)) / np.asarray(null.rest_scale)
    return np.log1p(np.clip(np.minimum(z[:18], z[31:49]), 0.0, None))


def _in_vain(paths: dict, effects) -> dict[str, float]:
    """What radio, rate loop and pose ask for, as far as the library can't give it."""
    radio = 0.0
    if paths["radio"] is not None:
        gain, _ = paths["radio"]
        radio = max(gain.values()) - max(v for k, v in gain.items() if set(k) <= set(effects))
    pose, rate = max(paths["pose"] or 0.0, 0.0), max(paths["rate"] or 0.0, 0.0)
    return {
        "radio in vain": float(np.log1p(radio)),
        "pose in vain": 0.0 if "state_latency" in effects else float(np.log1p(pose)),
        "rate in vain": 0.0 if "rate_gains" in effects else float(np.log1p(rate)),
    }
