"""From scores to a verdict: probabilities of every cause, of none and of something unknown.

The scores of the four paths add up. They are tempered, since residuals are never quite as independent and
forms never quite as right as a likelihood takes them to be; how much is settled once on a tuning set and
kept in `decision.json`."""

from __future__ import annotations

import itertools
import json
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np

from openjax.errors import UserError
from openjax.gap.evidence import Evidence
from openjax.gap.hypotheses import SetFit, score_of
from openjax.gap.rest import Rest

SETTINGS_FILE = Path(__file__).with_name("decision.json")


# Effects that stand in for one another: two of a family at once are rarely more than one of them in another
# form.
FAMILIES = (
    {"mass", "thrust_scale", "battery_sag"},
    {"rotor_drag", "wind", "blade_flapping"},
    {"motor_imbalance", "com_offset"},
    {"inertia", "yaw_torque"},
    {"thrust_curve", "thrust_saturation", "battery_sag"},
    {"ground_effect", "ceiling_effect"},
)


SAME = {"thrust_scale": "mass"}


@dataclass(frozen=True)
class Settings:
    """All numbers of the decision. Temperatures divide nats; costs are nats; shares are of the stronger
    effect's gain that a further effect must add, per path."""

    temperature: float = 3.0
    radio_temperature: float = 10.0
    rate_temperature: float = 3.0
    pose_temperature: float = 3.0
    effect_cost: float = 2.0
    radio_cost: float = 12.0
    rate_cost: float = 10.0
    pose_cost: float = 2.0
    least_loss: float = 0.006
    second_share: float = 0.01
    second_root: float = 0.0
    second_cost: float = 0.0
    cross_share: float = 0.005
    family_cost: float = 12.0
    prior_none: float = 0.3
    prior_sizes: tuple[float, ...] = (0.5, 0.17, 0.03)
    testable: float = 6.0
    rest_mean: tuple[float, ...] = ()
    rest_scale: tuple[float, ...] = ()
    unknown_weights: tuple[float, ...] = ()
    unknown_bias: float = -3.0
    unknown_threshold: float = 0.5
    notes: str = field(default="", compare=False)


def load_settings(path: str | Path | None = None) -> Settings:
    """Settings from a JSON file (default: the tuned ones that come with the package). Raises UserError."""
    path = SETTINGS_FILE if path is None else Path(path)
    try:
        table = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: not readable as JSON settings ({error.__class__.__name__})") from None
    known = {f.name for f in fields(Settings)}
    if not isinstance(table, dict) or (strange := sorted(set(table) - known)):
        raise UserError(f"{path}: unknown setting {strange[0] if isinstance(table, dict) else table!r}")
    return Settings(**{k: tuple(v) if isinstance(v, list) else v for k, v in table.items()})


@dataclass(frozen=True, eq=False)
class Decision:
    """`posterior` {set of effects: probability} given that the cause is in the library, `probabilities` of
    being the strongest cause (with none and unknown), `best` the most probable set, strongest first."""

    posterior: dict[tuple[str, ...], float]
    probabilities: dict[str, float]
    best: tuple[str, ...]
    unknown: float


def scores(evidence: Evidence, settings: Settings) -> dict[tuple[str, ...], float]:
    """Log posterior (up to a constant) of every set of effects over all paths."""
    return combine(path_scores(evidence), set(evidence.library.effects), settings)


def path_scores(evidence: Evidence) -> dict:
    """What the decision needs of the evidence, as plain numbers."""
    return {
        "sets": {k: score_of(v) - evidence.nothing.score for k, v in evidence.sets.items()},
        "radio": None if evidence.radio is None else (dict(evidence.radio.gain), evidence.radio.loss),
        "rate": None if evidence.rate_loop is None else evidence.rate_loop.score()[0],
        "pose": None if evidence.pose is None else evidence.pose.score()[0],
        "exposure": dict(evidence.exposure),
    }


def combine(paths: dict, effects: set[str], s: Settings) -> dict[tuple[str, ...], float]:
    """Log posterior of every set from `path_scores`."""
    physics = {}
    # What these flights could not show at its usual size is not named, however well it may fit.
    gains = {
        k: g for k, g in paths["sets"].items() if all(paths["exposure"].get(e, 0.0) >= s.testable for e in k)
    }
    for key, gain in gains.items():
        # A further effect must add its share of what the others explain: no form is exact.
        rest = (
            max((gains[k] for k in itertools.combinations(key, len(key) - 1) if k in gains), default=0.0)
            if len(key) > 1
            else 0.0
        )
        related = sum(len(family & set(key)) > 1 for family in FAMILIES)
        physics[key] = (
            gain / s.temperature
            - s.effect_cost * len(key)
            - (s.second_share * max(rest, 0.0) + s.second_root * np.sqrt(max(rest, 0.0))) * (len(key) > 1)
            - s.second_cost * max(len(key) - 1, 0)
            - s.family_cost * related
        )
    strongest = max(max(gains.values()), 0.0)
    others = {(): 0.0}
    if paths["radio"] is not None:
        gain, loss = paths["radio"]
        for key, value in gain.items():
            if key and all(e in effects for e in key) and not ("packet_loss" in key and loss < s.least_loss):
                others[key] = value / s.radio_temperature - s.radio_cost * len(key)
    for name, effect, temperature, cost in (
        ("rate", "rate_gains", s.rate_temperature, s.rate_cost),
        ("pose", "state_latency", s.pose_temperature, s.pose_cost),
    ):
        if paths[name] is not None and effect in effects:
            value = (paths[name] - s.cross_share * strongest) / temperature - cost
            others |= {(*k, effect): v + value for k, v in others.items()}
    sizes = [s.prior_none, *s.prior_sizes]
    count = len(effects)
    number = [1, count, count * (count - 1) / 2, count * (count - 1) * (count - 2) / 6]
    out = {}
    for (key, value), (more, extra) in itertools.product(physics.items(), others.items()):
        size = len(key) + len(more)
        if size < len(sizes):
            out[key + more] = value + extra + np.log(sizes[size] / number[size])
    return out


def strengths(evidence: Evidence) -> dict[str, float]:
    """How much each effect explains on its own, on one scale (nats)."""
    paths = path_scores(evidence)
    return strengths_of(paths)


def strengths_of(paths: dict) -> dict[str, float]:
    out = {k[0]: v for k, v in paths["sets"].items() if len(k) == 1}
    if paths["radio"] is not None:
        out |= {k[0]: v for k, v in paths["radio"][0].items() if len(k) == 1}
    out |= {"rate_gains": paths["rate"] or 0.0, "state_latency": paths["pose"] or 0.0}
    return out


def decide(evidence: Evidence, rest: Rest | None, settings: Settings) -> Decision:
    """Probabilities of all causes."""
    paths = path_scores(evidence)
    return decide_from(
        paths, set(evidence.library.effects), None if rest is None else rest.vector(), settings
    )


def decide_from(paths: dict, effects: set[str], rest, settings: Settings) -> Decision:
    """`decide` from plain numbers."""
    logs = combine(paths, effects, settings)
    top = max(logs.values())
    weights = {k: float(np.exp(v - top)) for k, v in logs.items()}
    total = sum(weights.values())
    posterior = {k: w / total for k, w in weights.items()}
    strong = strengths_of(paths)
    unknown = unknown_probability(rest, paths, effects, settings)
    probabilities = {e: 0.0 for e in effects}
    for key, p in posterior.items():
        if key:
            probabilities[max(key, key=lambda e: strong.get(e, 0.0))] += p * (1.0 - unknown)
    probabilities["none"] = posterior.get((), 0.0) * (1.0 - unknown)
    probabilities["unknown"] = unknown
    # Members of a class that motion can't split count together, so that they don't lose to none one by one.
    classes: dict[frozenset, float] = {}
    for key, p in posterior.items():
        name = frozenset(SAME.get(e, e) for e in key)
        classes[name] = classes.get(name, 0.0) + p
    winner = max(classes, key=classes.get)
    best = max((k for k in posterior if frozenset(SAME.get(e, e) for e in k) == winner), key=posterior.get)
    return Decision(posterior, probabilities, tuple(sorted(best, key=lambda e: -strong.get(e, 0.0))), unknown)


def unknown_features(rest, paths: dict, effects: set[str], s: Settings) -> np.ndarray:
    """The numbers that the unknown gate weighs: the rest's bands against nominal flights, how much of it a
    flexible model predicts, how unevenly it comes, how the flights agree, and how much was explained at
    all."""
    values = np.asarray(rest)
    z = (values - np.asarray(s.rest_mean)) / np.asarray(s.rest_scale)
    # Strong against the sensors' noise and strong in itself: neither other sensors nor noisier ones look
    # strange.
    bands = np.log1p(np.clip(np.minimum(z[:18], z[31:49]), 0.0, None))
    motion, accelerometer = np.sort(bands[:12]), np.sort(bands[12:])
    gain = max((g for k, g in paths["sets"].items() if set(k) <= effects), default=0.0)
    return np.array(
        [
            motion[-1],
            motion[-3],
            accelerometer[-1],
            bands[[2, 5]].max(),
            float(values[18:22].max()),
            np.log1p(max(z[24:28].max(), 0.0)),
            float(values[30]),
            np.log1p(max(gain, 0.0)) / 10.0,
            np.log1p(_unexplained(paths, effects)),
            np.log1p(max(paths["pose"] or 0.0, 0.0)) / 10.0 if "state_latency" in effects else 0.0,
        ]
    )


def _unexplained(paths: dict, effects: set[str]) -> float:
    """Nats by which radio and pose ask for an effect that the library lacks."""
    total = 0.0
    if paths["radio"] is not None:
        gain, _ = paths["radio"]
        total += max(gain.values()) - max(v for k, v in gain.items() if set(k) <= effects)
    if paths["pose"] is not None and "state_latency" not in effects:
        total += max(paths["pose"], 0.0)
    return total


def unknown_probability(rest, paths: dict, effects: set[str], s: Settings) -> float:
    """Probability that something acts which the library doesn't hold."""
    if rest is None or not s.unknown_weights:
        return 0.0
    x = unknown_features(rest, paths, effects, s)
    return float(1.0 / (1.0 + np.exp(-(s.unknown_bias + np.asarray(s.unknown_weights) @ x))))


def best_fit(evidence: Evidence, effects) -> SetFit:
    """The full fit of the physics part of a set."""
    return evidence.fit(tuple(e for e in evidence.library.physics if e in effects))
