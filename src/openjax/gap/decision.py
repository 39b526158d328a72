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
from openjax.gap import firmware
from openjax.gap.evidence import Evidence
from openjax.gap.gate import Null
from openjax.gap.hypotheses import SetFit, score_of
from openjax.gap.library import PLACE

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
HOPELESS = 40.0  # nats below the best
FLAT = 0.5  # change of the thrust's factor over the usual commands, relative to the factor's mean
CALM = 0.08  # m/s, a wind below which isn't one


@dataclass(frozen=True)
class Settings:
    """All numbers of the decision. Temperatures divide nats; costs are nats after that, except `second_cost`,
    `third_cost` and `null_gain`, which count before. `null_gain` {effect: nats that it gains on flights
    without a cause}; `form_share` {effect: share of its gain that another effect may add only because no form
    is exact}, with `second_share` for the rest. `unknown` {sign: (centre, scale, weight)} of the gate, against
    `null`, what nominal flights show. `sharpness` multiplies the log posterior at last; `doubt` is the share
    of every effect's probability that goes to unknown however well it fits. `form_error` {effect: share of its
    size by which a parameter may be off beyond its interval, one standard deviation}, `usual_form_error` for
    the rest."""

    temperature: float = 3.0
    radio_temperature: float = 10.0
    rate_temperature: float = 3.0
    pose_temperature: float = 3.0
    effect_cost: float = 2.0
    radio_cost: float = 12.0
    radio_both_cost: float = 0.0
    rate_cost: float = 10.0
    pose_cost: float = 2.0
    least_loss: float = 0.006
    null_gain: dict[str, float] = field(default_factory=dict)
    form_share: dict[str, float] = field(default_factory=dict)
    second_share: float = 0.005
    second_cost: float = 8.0
    third_cost: float = 8.0
    cross_share: float = 0.0
    family_cost: float = 0.0
    prior_none: float = 0.3
    prior_sizes: tuple[float, ...] = (0.5, 0.17, 0.03)
    testable: float = 6.0
    unknown: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    unknown_bias: float = -3.0
    unknown_threshold: float = 0.5
    sharpness: float = 1.0
    doubt: float = 0.0
    null: Null = field(default_factory=Null)
    form_error: dict[str, float] = field(default_factory=dict)
    usual_form_error: float = 0.05
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
    null = table.pop("null", {})
    if not isinstance(null, dict) or (strange := sorted(set(null) - {f.name for f in fields(Null)})):
        raise UserError(f"{path}: null: unknown entry {strange[0] if isinstance(null, dict) else null!r}")
    null = Null(**{k: tuple(v) if isinstance(v, list) else v for k, v in null.items()})
    return Settings(null=null, **{k: tuple(v) if isinstance(v, list) else v for k, v in table.items()})


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
        "rate": None if evidence.rate_loop is None else rate_score(evidence.rate_loop.score()),
        "pose": None if evidence.pose is None else evidence.pose.score()[0],
        "exposure": dict(evidence.exposure),
        "flat": flat_curve(evidence.sets.get(("thrust_curve",))),
        "calm": calm_air(evidence.sets.get(("wind",)), evidence.library.effects),
    }


def calm_air(fit: SetFit | None, effects) -> bool:
    """Whether the fitted wind hardly blows: then it is the vehicle's own drag."""
    if fit is None or "rotor_drag" not in effects:
        return False
    return float(np.hypot(*fit.theta[[PLACE["wind", "x"], PLACE["wind", "y"]]])) < CALM


def flat_curve(fit: SetFit | None) -> bool:
    """Whether the fitted thrust curve hardly bends: then it is another thrust or mass."""
    if fit is None:
        return False
    return flat(*fit.theta[[PLACE["thrust_curve", p] for p in ("offset", "slope", "curvature")]])


def flat(offset: float, slope: float, curvature: float) -> bool:
    """Whether offset + slope m + curvature m^2 is nearly a multiple of m over the usual commands."""
    m = np.linspace(0.45, 0.85, 9)
    change = offset / m + slope + curvature * m - 1.0
    return bool(np.ptp(change) < FLAT * abs(change.mean()))


def rate_score(score) -> float:
    """Nats for other gains of the rate loop, from a path's (score, theta, covariance). Where the loop
    saw other rates than the log, that isn't a change of gains (`firmware.lost_share`)."""
    value, theta, _ = score
    return float(value * (1.0 - firmware.lost_share(theta)))


def combine(paths: dict, effects: set[str], s: Settings) -> dict[tuple[str, ...], float]:
    """Log posterior of every set from `path_scores`. What the flights could not show at its usual size competes,
    but is not named: its sets count as what remains of them."""
    # What is another effect by its fitted value isn't named by this name.
    barred = {"wind"} if paths.get("calm", False) else set()
    if paths.get("flat", False) and effects & {"mass", "thrust_scale"}:
        barred.add("thrust_curve")
    physics, gains = {}, {k: g for k, g in paths["sets"].items() if not barred & set(k)}
    for key, gain in gains.items():
        value = gain - sum(s.null_gain.get(e, 0.0) for e in key)
        if len(key) > 1:
            # A further effect must add more than what the strongest one's form may have wrong.
            alone = {e: gains.get((e,), 0.0) for e in key}
            first = max(alone, key=alone.get)
            share = s.form_share.get(first, s.second_share)
            value -= (len(key) - 1) * (s.second_cost + share * max(alone[first], 0.0))
            value -= (len(key) - 2) * s.third_cost
        related = sum(len(family & set(key)) > 1 for family in FAMILIES)
        shown = tuple(e for e in key if paths["exposure"].get(e, 0.0) >= s.testable)
        value = value / s.temperature - s.effect_cost * len(key) - s.family_cost * related
        physics.setdefault(shown, []).append((len(key), value))
    strongest = max(max(gains.values()), 0.0)
    others = {(): 0.0}
    if paths["radio"] is not None:
        gain, loss = paths["radio"]
        for key, value in gain.items():
            if key and all(e in effects for e in key) and not ("packet_loss" in key and loss < s.least_loss):
                cost = s.radio_cost * len(key) + s.radio_both_cost * (len(key) - 1)
                others[key] = value / s.radio_temperature - cost
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
    # What is hopeless within its path isn't combined with anything.
    highest = max(value for values in physics.values() for _, value in values)
    physics = {k: v for k, v in physics.items() if not k or max(x for _, x in v) > highest - HOPELESS}
    highest = max(others.values())
    others = {k: v for k, v in others.items() if not k or v > highest - HOPELESS}
    for (key, values), (more, extra) in itertools.product(physics.items(), others.items()):
        logs = [
            value + np.log(sizes[size + len(more)] / number[size + len(more)])
            for size, value in values
            if size + len(more) < len(sizes)
        ]
        if logs:
            out[key + more] = float(np.logaddexp.reduce(logs)) + extra
    return out


def strengths(evidence: Evidence) -> dict[str, float]:
    """How much each effect explains on its own, on one scale (nats)."""
    return strengths_of(path_scores(evidence))


def strengths_of(paths: dict, among=None) -> dict[str, float]:
    """How much each effect explains, alone or as the part of a set `among` that goes without it."""
    out = {k[0]: v for k, v in paths["sets"].items() if len(k) == 1}
    if among is not None:
        own = {frozenset(k): v for k, v in paths["sets"].items()}
        inside = frozenset(e for e in among if e in out)
        if inside in own:
            out |= {e: own[inside] - own[inside - {e}] for e in inside if inside - {e} in own}
    if paths["radio"] is not None:
        out |= {k[0]: v for k, v in paths["radio"][0].items() if len(k) == 1}
    out |= {"rate_gains": paths["rate"] or 0.0, "state_latency": paths["pose"] or 0.0}
    return out


def decide(evidence: Evidence, features: dict[str, float] | None, settings: Settings) -> Decision:
    """Probabilities of all causes; `features` of the unknown gate (None: nothing unknown is considered)."""
    return decide_from(path_scores(evidence), set(evidence.library.effects), features, settings)


def decide_from(paths: dict, effects: set[str], features, settings: Settings, logs=None) -> Decision:
    """`decide` from plain numbers; `logs`: what `combine` gave, if known."""
    logs = combine(paths, effects, settings) if logs is None else logs
    top = max(logs.values())
    weights = {k: float(np.exp(settings.sharpness * (v - top))) for k, v in logs.items()}
    total = sum(weights.values())
    posterior = {k: w / total for k, w in weights.items()}
    unknown = unknown_probability(features, settings)
    probabilities = {e: 0.0 for e in effects}
    for key, p in posterior.items():
        if len(key) == 1:
            probabilities[key[0]] += p * (1.0 - unknown)
        elif key and p > 1e-9:
            strong = strengths_of(paths, key)
            probabilities[max(key, key=lambda e: strong.get(e, 0.0))] += p * (1.0 - unknown)
    doubt = settings.doubt * sum(probabilities.values())
    probabilities = {e: p * (1.0 - settings.doubt) for e, p in probabilities.items()}
    probabilities["none"] = posterior.get((), 0.0) * (1.0 - unknown)
    probabilities["unknown"] = unknown + doubt
    # Members of a class that motion can't split count together, so that they don't lose to none one by one.
    classes: dict[frozenset, float] = {}
    for key, p in posterior.items():
        name = frozenset(SAME.get(e, e) for e in key)
        classes[name] = classes.get(name, 0.0) + p
    winner = max(classes, key=classes.get)
    best = max((k for k in posterior if frozenset(SAME.get(e, e) for e in k) == winner), key=posterior.get)
    strong = strengths_of(paths, best)
    return Decision(posterior, probabilities, tuple(sorted(best, key=lambda e: -strong.get(e, 0.0))), unknown)


def unknown_probability(features: dict[str, float] | None, s: Settings) -> float:
    """Probability that something acts which the library doesn't hold: `unknown` {feature: (centre, scale,
    weight)}."""
    if features is None or not s.unknown:
        return 0.0
    total = s.unknown_bias + sum(w * (features[k] - c) / d for k, (c, d, w) in s.unknown.items())
    return float(1.0 / (1.0 + np.exp(-total)))


def best_fit(evidence: Evidence, effects) -> SetFit:
    """The full fit of the physics part of a set."""
    return evidence.fit(tuple(e for e in evidence.library.physics if e in effects))
