"""The split of the gap among accepted effects, sensors and the unexplained rest, on stretches that
no parameter was fitted to.

The gap is the rms over channels of each channel's prediction error over its floor:
velocity over 0.25 s as path and accelerometer say it, body rates over 0.05 s, the pose
against the gyroscope over 0.1 s, the motor commands from the body-rate commands. The
floor is what is left with all accepted effects, less what the residual check finds in
excess of noise. A share is what the gap's square grows by when one part goes and all
others stay (its usefulness, Darlington 1968), in proportion to that of all parts, so
that shares add up to one with what is unexplained.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import norm

from openjax.gap.decision import DECISION
from openjax.gap.evidence import Evidence
from openjax.gap.model.cross_validation import ablate, fit_to_others
from openjax.gap.model.replay import SKIP
from openjax.gap.model.table import ERRORS, with_effects
from openjax.gap.selection import DRAWS, Selection

METRIC = (
    "rms over channels of prediction error / noise floor on stretches left out (velocity over 0.25 "
    "s by path and by accelerometer, body rates over 0.05 s, pose against gyroscope over 0.1 s, "
    "motor commands from body-rate commands)"
)
# Nuisances that are the sensors' and the clocks': how they are mounted, biased,
# filtered and timed.
SENSORS = (
    "frame tilt",
    "level of the world",
    "IMU tilt",
    "accelerometer",
    "gyroscope's low-pass",
    "clock of",
)


@dataclass(frozen=True)
class Share:
    """Part of the gap's square, with its 90 % interval."""

    value: float
    interval90: tuple[float, float]


@dataclass(frozen=True)
class Gap:
    """The simulator's error, in units of the floor."""

    metric: str
    before: float
    """With no effect; sensors and clocks as the flights show them."""
    after: float
    """With the named effects."""
    floor: float
    reduction: float
    """1 - after / before."""
    interval90: tuple[float, float]
    """Of the reduction."""

    @property
    def probability_of_none(self) -> float:
        """That the named effects close no more of the gap than what matters."""
        low, high = self.interval90
        deviation = max((high - low) / 3.29, 1e-9)
        return float(norm.cdf((DECISION.least_gap - self.reduction) / deviation))

    def in_words(self) -> str:
        """A sentence on how far the gap shrinks, and a warning if it doesn't."""
        low, high = (100 * v for v in self.interval90)
        text = (
            f"Gap on held-out flights: {self.before:.2f} before, {self.after:.2f} after, "
            f"floor {self.floor:.2f}: "
            f"{100 * self.reduction:.0f} % smaller [{low:.0f}, {high:.0f}]."
        )
        if self.reduction < 0:
            text += " Caution: with these effects, held-out predictions are worse."
        return text


@dataclass(frozen=True)
class Split:
    """The gap, and what its parts take of it."""

    gap: Gap
    effects: dict[str, Share]
    sensors: Share
    """Of sensors and clocks."""
    unexplained: Share
    """Of what is more than noise, and no accepted effect."""
    largest: dict[str, float]
    """{part: share of the bootstrap's draws in which it is the largest}, of effects and
    "unexplained".
    """
    of_a_channel: dict[str, tuple[str, float]] = field(default_factory=dict)
    """{effect: a channel and the part that it takes of that one's gap, its largest}: what turns a
    vehicle all the time hides a wind from the whole, and not from the velocity.
    """

    def reach(self, effect: str) -> float:
        """The part that an effect may take, of the whole gap or of one channel's."""
        _, of_a_channel = self.of_a_channel.get(effect, ("", 0.0))
        return max(self.effects[effect].interval90[1], of_a_channel)

    def of_one_channel(self, effect: str) -> str:
        """The part of a channel for which an effect is named whose share is small."""
        channel, part = self.of_a_channel.get(effect, ("", 0.0))
        is_small = self.effects[effect].interval90[1] < DECISION.form_error < part
        return f"{part:.2f} of {channel}" if is_small else ""


def split(
    evidence: Evidence, selection: Selection, excess: Float[np.ndarray, "9"], effects
) -> Split:
    """Shares of the `effects`, of all paths. `excess` (9,): share of each
    motion channel's squared error that the residual check finds in excess of noise.
    """
    # (sets, blocks, channels)
    channels, squares = _squares_of_sets(evidence, selection, effects)
    excess_of = dict(zip(ERRORS, excess, strict=True))
    floor_shares = 1.0 - np.array([excess_of.get(n, 0.0) for n in channels])
    blocks = squares.shape[1]
    # the first row are the flights as they are, the others draws of a Bayesian
    # bootstrap
    draws = np.random.default_rng(0).dirichlet(np.ones(blocks), DRAWS)
    weights = np.concatenate([np.full((1, blocks), 1.0 / blocks), draws])
    values, squares_of_gap = shares_of_squares(squares, weights, floor_shares)
    names = (*effects, "sensors", "unexplained")
    low, high = np.quantile(values[1:], [0.05, 0.95], axis=0)
    shares = {}
    for name, value, start, end in zip(names, values[0], low, high, strict=True):
        # a share at the end of its range may lie beside the draws' quantiles
        interval = (float(min(start, value)), float(max(end, value)))
        shares[name] = Share(float(value), interval)
    rows = [k for k, n in enumerate(names) if n != "sensors"]
    first = np.argmax(values[1:][:, rows], 1)
    largest = {names[k]: float(np.mean(first == place)) for place, k in enumerate(rows)}
    return Split(
        gap=_gap(squares_of_gap),
        effects={e: shares[e] for e in effects},
        sensors=shares["sensors"],
        unexplained=shares["unexplained"],
        largest=largest,
        of_a_channel={
            effect: (channels[channel], float(part))
            for effect, channel, part in zip(
                effects, *shares_of_channels(squares.mean(1), floor_shares), strict=True
            )
        },
    )


def shares_of_channels(
    squares: Float[np.ndarray, "sets channels"], floor_share: Float[np.ndarray, " channels"]
) -> tuple[Int[np.ndarray, " effects"], Float[np.ndarray, " effects"]]:
    """Of each effect, of the channels of which it takes a part that counts, the one in which it
    does most; and that part, of the squares and floors that `shares_of_squares` takes. What does
    less than a floor takes none.
    """
    level = squares / (squares[:1] * floor_share + 1e-30)
    useful = level[3:-1] - level[0]
    whole = np.maximum(level[1:3].max(0) - 1.0, 1.0)
    parts = np.where(useful >= 1.0, np.minimum(useful / whole, 1.0), 0.0)
    most = np.argmax(np.where(parts >= DECISION.form_error, useful, parts), 1)
    return most, np.take_along_axis(parts, most[:, None], 1)[:, 0]


def shares_of_squares(
    squares: Float[np.ndarray, "sets blocks channels"],
    weights: Float[np.ndarray, "draws blocks"],
    floor_share: Float[np.ndarray, " channels"],
):
    """Shares (draws, parts + 1), what is unexplained last, and the gap's square before
    and after (draws, 2).

    squares (sets, blocks, channels): of all parts, none, none but the sensors, and all
    without each part. weights (draws, blocks). floor_share (channels,): of the squares
    that all parts leave, what is floor.
    """
    level = np.einsum("db,sbc->dsc", weights, squares)
    floor = level[:, :1] * floor_share + 1e-30
    level = (level / floor).mean(2)  # (draws, sets)
    full, raw, bare = level[:, :3].T
    whole = np.maximum(raw, bare) - 1.0
    # without a gap, all there is are the sensors
    sure = whole > 2.0 * DECISION.least_gap
    remainder = np.where(sure, np.clip((full - 1.0) / np.where(sure, whole, 1.0), 0.0, 1.0), 0.0)
    useful = np.maximum(level[:, 3:] - full[:, None], 0.0) * sure[:, None]
    useful[:, -1] += 1e-12  # the sensors take all where nothing else is of use
    shares = useful / useful.sum(1, keepdims=True) * (1.0 - remainder)[:, None]
    return np.concatenate([shares, remainder[:, None]], 1), np.stack([bare, full], 1)


def _gap(square: np.ndarray) -> Gap:
    """The gap from its square before and after (1 + draws, 2)."""
    reduction = 1.0 - np.sqrt(square[:, 1] / square[:, 0])
    low, high = np.quantile(reduction[1:], [0.05, 0.95])
    start, end = np.sqrt(square[0])
    value = float(reduction[0])
    return Gap(
        metric=METRIC,
        before=float(start),
        after=float(end),
        floor=1.0,
        reduction=value,
        interval90=(min(float(low), value), max(float(high), value)),
    )


def _squares_of_sets(
    evidence: Evidence, selection: Selection, effects
) -> tuple[list[str], np.ndarray]:
    """Channels, and their squared errors (sets, blocks, channels) by set of parts, as
    `shares_of_squares` takes them.
    """
    table = selection.table
    coefficients = fit_to_others(table, with_effects(table))
    # Numbers of the vehicle and what feedback makes of gusts are no sensor's fault and
    # no effect: they stay.
    sensors = np.array([n.startswith(SENSORS) for n in evidence.replay.nuisance_names])
    never = [e for e in selection.fit.effects if e not in effects]

    def squares(present, off=None) -> dict[str, np.ndarray]:
        absent = [e for e in effects if e not in present and e in selection.fit.effects]
        motion = ablate(table, coefficients, (*never, *absent), off) / table.rows[:, None]
        channels = np.array(ERRORS)[evidence.replay.usable > 0]
        of_motion = dict(zip(channels, motion.T, strict=True))
        of_channels = [e for e in present if e not in selection.fit.effects]
        return of_motion | _other_squares(evidence, of_channels, table)

    sets = [squares(effects), squares((), sensors), squares(())]
    sets += [squares([e for e in effects if e != absent]) for absent in effects]
    sets.append(squares(effects, sensors))
    return list(sets[0]), np.stack([np.stack(list(s.values()), 1) for s in sets])


def _other_squares(evidence: Evidence, effects, table) -> dict[str, np.ndarray]:
    """{channel: (blocks,) mean squared errors} of pose, rate loop and radio with the
    effects `effects`.
    """
    counts = [int((table.track_of == k).sum()) for k in range(len(evidence.tracks))]
    out: dict[str, np.ndarray] = {}
    for channel in evidence.channels:
        for name, series in channel.residuals(effects).items():
            blocks = []
            for track, errors, count in zip(evidence.tracks, series, counts, strict=True):
                # of some channels one number is known of a whole flight
                errors_in_blocks = errors[int(SKIP / track.dt) :]
                if len(errors) == 1:
                    errors_in_blocks = np.repeat(errors, count)
                blocks += [float((b**2).mean()) for b in np.array_split(errors_in_blocks, count)]
            out[name] = np.array(blocks)
    return out
