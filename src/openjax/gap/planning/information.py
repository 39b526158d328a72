"""The information that each segment of flight is expected to give.

A segment is flown by the nominal simulator. Of two causes i and j it then shows d_ij =
1/2 |f_i - f_j|^2 nats, in units of the noise, less what nuisances and the parameters of
j can take. Its value is sum_ij p_i p_j (1 - exp(-(d_ij - 8) / 2)), for the 8 nats that
a diagnosis asks for: the probability that two causes drawn from what is believed are
told apart (T-optimal design: Atkinson, Fedorov 1975; the bound is Bhattacharyya's). The
air is as uneven as in a quiet hall: in still air every segment would tell everything.
"""

import itertools
from dataclasses import dataclass, field, replace
from functools import lru_cache

import jax
import numpy as np

from openjax.background import one_blas_thread
from openjax.flights.flight import Case
from openjax.flights.reading import flights_of
from openjax.flights.samples import Turbulence, fly, log_of
from openjax.flights.segments import SEGMENTS
from openjax.gap.criteria import DETECTABLE
from openjax.gap.decision import DECISION
from openjax.gap.evidence import gather
from openjax.gap.model.library import library, places, prior
from openjax.gap.model.replay import Replay
from openjax.vehicle.vehicle_file import VehicleFile
from openjax.vehicle.vehicle_tables import Motor

SECONDS = 10.0  # of each segment that are simulated


@dataclass(frozen=True, eq=False)
class Belief:
    """A cause, or several at once."""

    effects: tuple[str, ...]
    theta: np.ndarray
    """(P,) where their parameters are."""
    probability: float

    @property
    def name(self) -> str:
        """In words."""
        return " and ".join(self.effects) or "nothing"


@dataclass(frozen=True)
class Promise:
    """The information that a segment promises."""

    segment: str
    value: float
    """Probability that two causes drawn from what is believed are told apart."""
    pair: tuple[str, str]
    """Of causes, which it tells better than other segments for what they are worth."""
    nats: float
    """By which one segment tells them."""


@dataclass(frozen=True, eq=False)
class Advice:
    """Advice on the next flight."""

    promises: tuple[Promise, ...]
    """Best first."""
    segments: tuple[str, ...]
    """The fewest segments that together tell nearly what all do."""
    nats: dict[tuple[str, str], float]
    """{(cause, other): nats of the best segment}."""


@one_blas_thread
def advise(beliefs: list[Belief], vehicle_file: VehicleFile) -> Advice:
    """Rank all segments by what they are expected to tell."""
    replay = replay_segments(nominal_of(vehicle_file))
    apart = _distances(replay, beliefs)
    weights = np.array([b.probability for b in beliefs])
    together = np.outer(weights, weights)
    promises = []
    usual = together * _distinction(apart).mean(0)
    for number, name in enumerate(replay.flights):
        gains = together * _distinction(apart[number])
        beyond = np.triu(gains - usual, 1)  # what every segment tells is no reason
        i, j = np.unravel_index(int(np.argmax(beyond)), gains.shape)
        pair = (beliefs[i].name, beliefs[j].name)
        promises.append(
            Promise(name.split(".")[0], float(gains.sum()), pair, float(apart[number, i, j]))
        )
    picks = _fewest(apart, together)
    best = apart.max(0)
    nats = {}
    for i, j in itertools.combinations(range(len(beliefs)), 2):
        nats[beliefs[i].name, beliefs[j].name] = float(best[i, j])
    ranking = tuple(sorted(promises, key=lambda p: -p.value))
    names = [name.split(".")[0] for name in replay.flights]
    return Advice(ranking, tuple(names[k] for k in picks), nats)


def _distinction(nats: np.ndarray) -> np.ndarray:
    """Probability that two causes so many nats apart are told from each other by a
    diagnosis that asks for DETECTABLE of them.
    """
    return 1.0 - np.exp(-0.5 * np.maximum(nats - DETECTABLE, 0.0))


def _fewest(apart: np.ndarray, together: np.ndarray) -> list[int]:
    """Segments, each adding most to those before, until they tell nearly what all do
    (nats of flights add up).
    """

    def value(nats):
        return float((together * _distinction(nats)).sum())

    everything = value(apart.sum(0))
    picks: list[int] = []
    sums = np.zeros_like(together)
    while value(sums) < DECISION.plan_share * everything and len(picks) < len(apart):
        rest = [k for k in range(len(apart)) if k not in picks]
        picks.append(max(rest, key=lambda k: value(sums + apart[k])))
        sums = sums + apart[picks[-1]]
    return picks or [int(np.argmax([value(a) for a in apart]))]


@dataclass(frozen=True)
class Nominal:
    """A vehicle without effects; two with the same numbers are equal."""

    numbers: tuple[bytes, ...]
    airframe: str
    mass_weighed: bool
    vehicle_file: VehicleFile = field(compare=False)


def nominal_of(vehicle_file: VehicleFile) -> Nominal:
    """The vehicle that a file describes, without effects."""
    leaves = jax.tree.leaves(vehicle_file.vehicle)
    numbers = tuple(np.asarray(leaf).tobytes() for leaf in leaves)
    # what is simulated commands thrust in the nominal order, whatever its own logs hold
    tables = {"log": {"motor_rows": "mean"}, "motor": Motor(), "vehicles": {}}
    file_of_means = replace(vehicle_file, **tables)
    return Nominal(numbers, vehicle_file.airframe, vehicle_file.mass_weighed, file_of_means)


# one vehicle is mostly asked about again and again, and its flights take seconds
@lru_cache(maxsize=1)
def replay_segments(nominal: Nominal) -> Replay:
    """The replay of every segment, flown by a vehicle without effects."""
    vehicle = nominal.vehicle_file.vehicle
    flights = []
    for number, (name, segment) in enumerate(SEGMENTS.items()):
        air = Turbulence()
        columns = fly(vehicle, vehicle, segment.reference(SECONDS), seed=number, air=air)
        parts, _ = flights_of(log_of(columns, name), (0, 1, 2, 3))
        flights += parts
    case = Case("segments", tuple(flights), nominal.vehicle_file)
    return gather(case, library()).motion.replay


def _distances(replay: Replay, beliefs: list[Belief]) -> np.ndarray:
    """(F, B, B) nats by which each flight tells a cause from another."""
    predictions = replay.predict(np.array([b.theta for b in beliefs]))
    out = np.zeros((len(replay.flights), len(beliefs), len(beliefs)))
    for j, belief in enumerate(beliefs):
        index = places(belief.effects)
        slopes = [c[1:] for c in replay.linearise(belief.theta, index)]
        columns = [
            np.concatenate([p - p[j][None], s]) for p, s in zip(predictions, slopes, strict=True)
        ]
        grams = replay.grams(columns)
        count = len(beliefs)
        _, _, precision = prior(belief.effects, size_factors=replay.size_factors)
        for flight, gram in enumerate(grams):
            inside = gram[count:, count:] + precision
            projection = np.linalg.solve(inside, gram[count:, :count])
            distances = np.diag(gram[:count, :count] - gram[:count, count:] @ projection)
            out[flight, :, j] = 0.5 * np.maximum(distances, 0.0)
    return of_pairs(out, beliefs)


def of_pairs(nats: np.ndarray, beliefs: list[Belief]) -> np.ndarray:
    """(F, B, B) nats of pairs, from those (F, B, B) by which what one cause does speaks
    against another. A cause is told from another only if neither can imitate the other;
    but one that holds the other's effects and more imitates it always, so there what it
    does more counts.
    """
    out = np.minimum(nats, np.swapaxes(nats, 1, 2))
    for i, more in enumerate(beliefs):
        for j, less in enumerate(beliefs):
            if set(less.effects) < set(more.effects):
                out[:, i, j] = out[:, j, i] = nats[:, i, j]
    return out
