"""Wakes of other vehicles as they are felt: late, and in gusts.

Air that arrives under another vehicle left it some tenths of a second ago, and passes
by a vehicle that is no longer there: of some speeds of fall the likeliest is taken.

A real wake also wanders and arrives in puffs. Of a vehicle that passes through it
little is left on average, and what is left looks like wind or drag. But it shakes: what
the replay doesn't predict is louder under another vehicle than elsewhere in the same
flights. How much louder is told by the innovations' mean squares over visits below the
other one and over stretches elsewhere (Welch's test of their logarithms). Where it is
clear, rows under the other one count by their own noise, so that puffs aren't evidence
of anything else. The effect that acts there alone has the nats of the test for it, and
those that its mean push has by the noise elsewhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import norm, t

from openjax.flights.shapes import Chosen
from openjax.flights.track import Track
from openjax.gap.decision import DECISION
from openjax.gap.model.hypotheses import SetFit, fit_set, fit_single, without_nuisances
from openjax.gap.model.replay import BLOCK, GROUPS, SKIP, Replay

ABOVE = (0.05, 1.5)  # m, how far above the other vehicle flies
ASIDE = 0.2  # m, to the side: a wake's width at a metre below, and its wandering
LINGERS = 0.3  # s: a wake falls with some 2 m/s, and sensors and motors answer
SHORTEST = 0.1  # s of a visit, or of a stretch elsewhere, that is compared
# s of a track elsewhere; below, other tracks of the case are asked as well
FEWEST_HERE = 2.0
SPEEDS = (4.0, 2.5, 1.5)
"""m/s, at which air falls: of the disc of a vehicle of 30 g 4.3, by momentum theory,
and less below where the jet has widened.
"""


@dataclass(frozen=True, eq=False)
class Gusts:
    """Gusts under other vehicles, as a case shows them."""

    rows: tuple[Bool[np.ndarray, " _"], ...]
    """(T,) of each track: under another vehicle, or just before."""
    louder: dict[tuple[int, ...], float]
    """{axes of the groups that are clearly louder there: by which factor in the mean
    square}.
    """
    nats: float
    """For a wake; 0 where nothing is clear."""

    def in_words(self) -> str:
        """The finding, as a sentence."""
        most = max(self.louder.values()) ** 0.5
        return (
            f"under another vehicle motion is {most:.1f} times as uneven as elsewhere: its wake is "
            "felt as gusts"
        )


def fit_wake(replay: Replay, effect: str) -> SetFit:
    """The fit of the effect that acts under others alone, with wakes at the likeliest
    speed.
    """
    at_once = fit_single(replay, effect)
    late = [fit_single(with_late_wakes(replay, speed), effect) for speed in SPEEDS]
    best = max(late, key=lambda fit: fit.score)
    return best if best.score > at_once.score + DECISION.wake_nats else at_once


def with_late_wakes(replay: Replay, speed: float) -> Replay:
    """The replay with other vehicles where they were when the air left them that
    arrives now, having fallen at a speed (m/s).
    """
    paths = []
    for path in replay.physics.paths:
        others = path.others.copy()
        rows = np.arange(len(others), dtype=float)
        for other in np.moveaxis(others, 1, 0):
            above = np.clip(other[:, 2] - path.position[:, 2], 0.0, ABOVE[1])
            departure = np.maximum(rows - above / speed / float(path.dt), 0.0)
            other[:, :2] = np.stack(
                [np.interp(departure, rows, x) for x in other[:, :2].T.copy()], 1
            )
        paths.append(path.replace(others=others))
    return replace(replay, physics=replace(replay.physics, paths=tuple(paths)))


def under_another(track: Track) -> Chosen:
    """(T,) whether another vehicle flies above, or did within the time that its wake
    takes.
    """
    near = np.zeros(len(track), bool)
    if track.position is None:
        return near
    for other in track.neighbours:
        gap = other - track.position
        above = (gap[:, 2] > ABOVE[0]) & (gap[:, 2] < ABOVE[1])
        near |= above & (np.hypot(gap[:, 0], gap[:, 1]) < ASIDE)
    # a row is under the wake for as long after the other one has passed
    late = np.convolve(near, np.ones(1 + round(LINGERS / track.dt)))[: len(near)]
    return late > 0.5


def read_gusts(fit: SetFit) -> Gusts:
    """The gusts that a fit leaves: of nothing, or of the effect that acts under others
    alone.
    """
    replay = replace(fit.replay, loudness=None)
    rows = tuple(under_another(track) for track in replay.tracks)
    innovations_of_tracks = [
        replay.whiten(without_nuisances(fit.replay, column[0], k), k)
        for k, column in enumerate(fit.columns)
    ]
    louder = {}
    far = 0.0
    for axes, _ in GROUPS:
        if replay.usable[axes[0]]:
            ratio, errors = louder_in(
                replay.tracks, rows, [w[:, list(axes)] for w in innovations_of_tracks]
            )
            if errors > DECISION.clear_errors and ratio > DECISION.wake_loudness:
                louder[axes] = ratio
                far = max(far, min(errors, DECISION.wake_errors))
    return Gusts(rows, louder, 0.5 * far**2)


def louder_in(
    tracks: Sequence[Track],
    rows: Sequence[Bool[np.ndarray, " _"]],
    innovations_of_tracks: Sequence[Float[np.ndarray, "_ axes"]],
) -> tuple[float, float]:
    """By which factor mean squares of innovations (T', axes) are larger in the chosen
    rows than elsewhere, and how many standard errors the logarithm is from none.
    """
    inside: list[float] = []
    outside: list[float] = []
    aside: list[float] = []
    for track, mask, white in zip(tracks, rows, innovations_of_tracks, strict=True):
        inside_rows = mask[int(SKIP / track.dt) :]
        squares = (white**2).mean(1)
        elsewhere = _stretches(squares, ~inside_rows, track.dt)
        if inside_rows.any():
            inside += _stretches(squares, inside_rows, track.dt)
        near = inside_rows.any() and (~inside_rows).sum() * track.dt > FEWEST_HERE
        (outside if near else aside).extend(elsewhere)
    if len(outside) < DECISION.wake_visits:
        outside = outside + aside
    if min(len(inside), len(outside)) < DECISION.wake_visits:
        return 1.0, 0.0
    parts = [np.log(np.maximum(values, 1e-12)) for values in (inside, outside)]
    spread = np.array([part.var(ddof=1) / len(part) for part in parts]) + 1e-12
    ratio = float(parts[0].mean() - parts[1].mean())
    freedom = spread.sum() ** 2 / (spread**2 / [len(part) - 1 for part in parts]).sum()
    # as many standard errors of a normal distribution as Student's says
    return float(np.exp(ratio)), float(-norm.ppf(t.sf(ratio / spread.sum() ** 0.5, freedom)))


def _stretches(squares: np.ndarray, mask: Chosen, dt: float) -> list[float]:
    """Mean squares of stretches of chosen rows, none longer than a block."""
    edges = np.flatnonzero(np.diff(mask.astype(int), prepend=0, append=0)).reshape(-1, 2)
    means = []
    for begin, end in edges:
        pieces = max(round((end - begin) * dt / BLOCK), 1)
        for piece in np.array_split(squares[begin:end], pieces):
            if len(piece) * dt >= SHORTEST:
                means.append(float(piece.mean()))
    return means


def as_loud_as(gusts: Gusts, replay: Replay, effects: Sequence[str]) -> tuple[Replay, Gusts]:
    """A replay whose noise is as loud under other vehicles as the gusts are, and these
    with the nats that the effect of wakes, if there is one in `effects`, loses by that.
    """
    louder = _louder(replay, gusts)
    loss = 0.0
    for effect in effects:
        quiet = fit_single(replay, effect).score - fit_set(replay, ()).score
        loss = max(quiet - fit_single(louder, effect).score + fit_set(louder, ()).score, 0.0)
    return louder, replace(gusts, nats=gusts.nats + loss)


def _louder(replay: Replay, gusts: Gusts) -> Replay:
    if replay.loudness is None:
        return replay
    loudness = []
    for track, mask, loud in zip(replay.tracks, gusts.rows, replay.loudness, strict=True):
        inside_rows = mask[int(SKIP / track.dt) :]
        loudness_here = loud.copy()
        for axes, ratio in gusts.louder.items():
            quiet = (
                np.sqrt((loud[~inside_rows][:, axes] ** 2).mean()) if (~inside_rows).any() else 1.0
            )
            columns = np.ix_(inside_rows, axes)
            loudness_here[columns] = np.maximum(loudness_here[columns], quiet * ratio**0.5)
        loudness.append(loudness_here)
    return replace(replay, loudness=tuple(loudness))
