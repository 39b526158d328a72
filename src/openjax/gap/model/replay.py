"""Replay of the motion: what was measured along each track against what the nominal
vehicle would have measured.

Residuals are compared through noise models (`whitening`), with the nuisances
marginalised per flight.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import solve_triangular

from openjax.flights.track import Track
from openjax.gap.model.library import ABSENT, CARDS, PLACE, STEP, absent_beside, places, prior
from openjax.gap.model.nuisances import OF_A_BLOCK, SIZE, columns_of
from openjax.gap.model.prediction import FORCE, RATES, VELOCITY, Physics, make_physics
from openjax.gap.model.whitening import Noise, first_noise, whiten
from openjax.gap.shapes import Hypotheses, Nuisances, Parameters, Rows

# Groups of channels that share a noise model: axes, whether integrated.
GROUPS = (
    ((0, 1), True),
    ((2,), True),
    ((3, 4), True),
    ((5,), True),
    ((6, 7), False),
    ((8,), False),
)
# what whitens before the first fit; its residuals then give each case a noise of its
# own
FIRST_NOISE = (0.03, 0.03, 0.006, 0.006, 0.25, 0.25)
MOTORS_LATE = ("clock of the motors", "delay of the motors")
SKIP = 0.2  # s left out at the start of a track: rotor speeds are not known there
BLOCK = 1.0  # s that are left out together: gusts and sensors forget within less


@dataclass(frozen=True, eq=False)
class Replay:
    """All tracks of a case under one nominal vehicle each, and their noise. What noise
    models make of the nuisances is worked out once.
    """

    physics: Physics
    measurements: list[np.ndarray]  # (T, 9)
    nominal: list[np.ndarray]  # (T, 9)
    columns: list[np.ndarray]  # (N, T, 9) nuisances, each of its usual size
    nuisance_names: tuple[str, ...]
    sizes: list[
        np.ndarray
    ]  # usual ones of each track's numbers, propellers, motors' clock and delay
    numbers: tuple  # the vehicle's numbers
    usable: np.ndarray  # (9,) channels that were logged
    noises: tuple[Noise, ...]  # unlogged channels have one, but count nothing
    loudness: tuple[np.ndarray, ...] | None = (
        None  # (T', 9) of each track, in units of the noise models
    )
    # (P,) the vehicle while nothing acts
    absent: np.ndarray = field(default_factory=ABSENT.copy)
    mixing: np.ndarray | None = None  # (N, N) of `columns` to independent ones
    # {effect: mean and covariance of its parameters} by other estimators
    other_sizes: Mapping[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)

    @property
    def tracks(self) -> tuple[Track, ...]:
        return self.physics.tracks

    @cached_property
    def nuisances(self) -> list[np.ndarray]:
        """(N, T, 9) of each track, in units of their standard deviations."""
        if self.mixing is None:
            return self.columns
        return [np.tensordot(self.mixing, c, 1) for c in self.columns]

    @property
    def size_factors(self) -> Parameters:
        """(P,) by what usual sizes of parameters are multiplied for a vehicle of this
        size; every replay of the same physics shares them.
        """
        return self.physics.size_factors

    def prior(self, effects: Collection[str]):
        """As `library.prior` has it, of this vehicle and what others told of it."""
        return prior(effects, self.absent, self.size_factors, self.other_sizes)

    def alone(self, effects: Collection[str], theta: Parameters) -> Parameters:
        """(P,) these effects as in theta (P,), and nothing else."""
        out = absent_beside(effects, self.absent).copy()
        out[places(effects)] = theta[places(effects)]
        return out

    @cached_property
    def flights(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(t.flight for t in self.tracks))

    @cached_property
    def flight_of(self) -> np.ndarray:
        """(tracks,) index of a track's flight."""
        return np.array([self.flights.index(t.flight) for t in self.tracks])

    @cached_property
    def is_shared(self) -> np.ndarray:
        """(N,) whether a nuisance belongs to the vehicle (all flights) or to a
        block.
        """
        return np.array([not n.startswith(OF_A_BLOCK) for n in self.nuisance_names])

    @cached_property
    def whitened_nuisances(self) -> list[np.ndarray]:
        """(N, T', 9) of each track."""
        return [self.whiten(n, k) for k, n in enumerate(self.nuisances)]

    @cached_property
    def nuisance_grams(self) -> list[np.ndarray]:
        """(N, N) inner products of each track's whitened nuisances."""
        flat = [n.reshape(len(n), -1) for n in self.whitened_nuisances]
        return [n @ n.T for n in flat]

    @cached_property
    def _roots(self) -> list[np.ndarray]:
        return [np.linalg.cholesky(np.eye(len(g)) + g) for g in self.nuisance_grams]

    def predict(self, theta: Hypotheses) -> list[Float[np.ndarray, "hypotheses _ channels"]]:
        """Channels (B, T, 9) of each track for parameter vectors theta (B, P)."""
        return self.physics.predict(theta)

    def around(self, theta: Parameters) -> Replay:
        """With the derivatives of a vehicle that has the effects theta (P,): a wrong
        moment of inertia scales the torques that are left once an effect is accounted
        for, not those of motors that hold against it.
        """
        places = [PLACE[key[:2]] for key in self.numbers] + [len(theta) - 2, len(theta) - 1]
        columns = []
        derivatives = (column[1:] for column in self.linearise(theta, places))
        for m, old, size in zip(derivatives, self.columns, self.sizes, strict=True):
            # a delay of the motors does what their clock does; only its usual size is
            # another
            fresh = np.concatenate([m, m[-1:]]) * size[:, None, None]
            columns.append(np.concatenate([fresh, old[len(fresh) :]]))
        return replace(self, columns=columns)

    def whiten(
        self, x: Float[np.ndarray, "*sets rows channels"], track: int
    ) -> Float[np.ndarray, "*sets later channels"]:
        """x (..., T, 9) of a track -> (..., T', 9) in units of the noise, without the
        first moments.
        """
        out = whiten(self.noises, x)
        out *= self.usable
        out = out[..., int(SKIP / self.tracks[track].dt) :, :]
        return out if self.loudness is None else out / self.loudness[track]

    def grams(
        self, columns: list[Float[np.ndarray, "columns _ channels"]]
    ) -> Float[np.ndarray, "flights columns columns"]:
        """Inner products (F, C, C) per flight of columns [(C, T, 9) per track],
        nuisances marginalised.
        """
        total = np.zeros((len(self.flights), len(columns[0]), len(columns[0])))
        for number, column in enumerate(columns):
            w = self.whiten(column, number).reshape(len(column), -1)
            n = self.whitened_nuisances[number]
            cross = n.reshape(len(n), -1) @ w.T
            projection = solve_triangular(
                self._roots[number], cross, lower=True, check_finite=False
            )
            total[self.flight_of[number]] += w @ w.T - projection.T @ projection
        return total

    def nuisance_sizes(self, residual: Rows, track: int) -> Nuisances:
        """(N,) the nuisances' most likely sizes, given a residual (T, 9) of a track."""
        gram = self.nuisance_grams[track]
        n = self.whitened_nuisances[track]
        return np.linalg.solve(
            np.eye(len(gram)) + gram, n.reshape(len(n), -1) @ self.whiten(residual, track).ravel()
        )

    def linearise(
        self, theta: Parameters, index: Int[np.ndarray, " free"] | Sequence[int]
    ) -> list[np.ndarray]:
        """Residual and derivatives (1 + p, T, 9) of each track at theta (P,) with
        respect to theta[index].
        """
        count = len(index)
        steps = (STEP * self.size_factors)[np.asarray(index, int)]
        batch = np.repeat(theta[None], count + 1, 0)
        batch[np.arange(count) + 1, index] += steps
        return [
            np.concatenate([(y - p[0])[None], (p[1:] - p[:1]) / steps[:, None, None]])
            for y, p in zip(self.measurements, self.predict(batch), strict=True)
        ]


def make_replay(
    tracks, vehicles, motor_ticks, feedback, numbers, clocks=(True, False), baseline=None
) -> Replay:
    """Replay of tracks with their nominal vehicles and motor commands (T, TICKS, 4) of
    the rate loop's ticks. `feedback` of each track: what it made of the motors may be
    anything in strength and lag. `clocks` are `one_clock` and `at_once`. Without the
    former the IMU's stream and the motors' are apart by unknown times: the IMU counts
    nothing, and the motors may be off by tens of milliseconds. With the latter motor
    commands are single samples, whose quick part and time within a row aren't known.
    `baseline`: what the vehicle is like while nothing acts.
    """
    one_clock, at_once = clocks
    absent = ABSENT if baseline is None else baseline.theta
    usable = np.ones(9)
    if any(t.velocity is None for t in tracks):
        usable[VELOCITY] = 0.0
    if any(t.specific_force is None for t in tracks):
        usable[FORCE] = 0.0
    # without a path the gyroscope is all there is, whatever its clock
    if not one_clock and usable[3]:
        usable[RATES] = usable[FORCE] = 0.0
    # motors made from commands tell the thrust, not how a real loop shares it out
    if usable[3:].any() and not all(t.motors_logged for t in tracks):
        usable[RATES] = 0.0
    physics = make_physics(tracks, vehicles, motor_ticks)
    nominal = [p[0] for p in physics.predict(absent[None])]
    columns_of_tracks = [
        columns_of(track, path, p, feedback_of_track, at_once)
        for track, path, p, feedback_of_track in zip(
            tracks, physics.paths, nominal, feedback, strict=True
        )
    ]
    names = tuple(dict.fromkeys(name for columns in columns_of_tracks for name in columns))
    moving = (*(" ".join(key[:2]) for key in numbers), "propellers' inertia", *MOTORS_LATE)
    usual_sizes = [key[2] for key in numbers]
    apart = SIZE["motor_clock" if one_clock else "streams_apart"]
    sizes = [
        np.array(
            [
                *usual_sizes,
                SIZE["propeller"],
                max(apart, t.dt / 4 if at_once else 0.0),
                SIZE["motor_delay"],
            ]
        )
        for t in tracks
    ]
    replay = Replay(
        physics,
        [_measurements(t) for t in tracks],
        nominal,
        [
            np.stack([columns.get(n, np.zeros_like(base)) for n in (*moving, *names)])
            for columns, base in zip(columns_of_tracks, nominal, strict=True)
        ],
        (*moving, *names),
        sizes,
        numbers,
        usable,
        tuple(first_noise(a, i, d) for (a, i), d in zip(GROUPS, FIRST_NOISE, strict=True)),
        absent=absent.copy(),
    ).around(absent)
    if not any(CARDS[key[0]].balanced for key in numbers):  # trims are told otherwise
        replay = replace(
            replay, columns=[_without_mean_torque(c, len(numbers)) for c in replay.columns]
        )
    mixing = None if baseline is None else baseline.mixing(replay.nuisance_names)
    return replace(replay, mixing=mixing)


def _without_mean_torque(nuisances: np.ndarray, count: int) -> np.ndarray:
    """Nuisances (N, T, 9), the first `count` of them without their mean torque: as long
    as it isn't known what acts, motors that pull one way all the time hold against
    something, and of a sum of torques that is zero no number can be wrong.
    """
    out = nuisances.copy()
    # of integrals a mean torque is the straight line to their end
    out[:count, :, RATES] -= np.linspace(0.0, 1.0, out.shape[1])[:, None] * out[:count, -1:, RATES]
    return out


def block_count(rows: int, dt: float) -> int:
    """Into how many blocks so many rows of dt s are cut."""
    return max(rows // max(int(BLOCK / dt), 1), 1)


def _measurements(track: Track) -> np.ndarray:
    out = np.zeros((len(track), 9))
    out[:, RATES] = track.body_rates - track.body_rates[0]
    if track.velocity is not None:
        out[:, VELOCITY] = track.velocity - track.velocity[0]
    if track.specific_force is not None:
        out[:, FORCE] = track.specific_force
    return out
