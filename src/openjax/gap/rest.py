"""What the accepted effects leave: how much of it follows anything that the log knows, on stretches left out.

A dictionary of plain regressors - place, motion, motor commands, voltage, the vehicle above - pushes and turns the
vehicle along each axis, without any effect's form. Its columns go through the same replay, noise models, nuisances and
folds as the effects do. Angular accelerations, which share the gyroscope's noise with what is to be explained, are not
among them, and what hardly happened in the flights is kept small.

Not everything that the rest follows says that something unknown acts. What follows thrust, motors, voltage, speed, floor or
ceiling is what an effect of the list has wrong, or feedback's answer to gusts, which drives the motors just as a thrust curve
would: strange is what none of them does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from openjax.flights.track import Track, rotation, smooth
from openjax.gap.evidence import Evidence
from openjax.gap.hypotheses import SetFit, without_nuisances
from openjax.gap.judging import judge, offers, solve
from openjax.gap.knocks import knocks
from openjax.gap.levers import torques
from openjax.gap.library import SAMPLED_NUISANCES
from openjax.gap.nuisances import torque_channels
from openjax.gap.replay import FORCE, RATES, VELOCITY, Replay
from openjax.gap.selection import LEAST_NATS, Selection, testable
from openjax.gap.spectral_lines import lines
from openjax.gap.table import build, widened, with_effects
from openjax.vehicle.effects.effect import ARENA_CEILING

SPREAD = 0.3  # m/s^2 and, times TORQUE, rad/s^2: prior rms of a regressor's part of the motion
TORQUE = 10.0
MOST = 6  # regressors at once
RADIUS = 0.023  # m, of a propeller
RARE = 0.3  # of a regressor's usual size: what happened less isn't blown up
LEAST_CHANGE = 0.15  # of it: what changed less isn't called strange
WIDTH = 0.25  # m of the radial functions of the place
STEADY = (
    "force by wind along world x",
    "force by wind along world y",
)  # what a frame that leans does as well
# Regressors of the motion itself, by force along it.
ALONG = ("force x by velocity", "force y by velocity", "force z by vertical speed")


# What an effect of the list would do as well, or feedback.
LIKE_AN_EFFECT, STRANGE, PLAIN = range(3)


class Regressor(NamedTuple):
    """`values` (T, 3): acceleration in the body frame, "force" m/s^2 or "torque" rad/s^2; `usual`: its usual size; `rank`:
    whether an effect of the list does the like (`like`: which; none: feedback does), or else whether it is one of many (places,
    headings) or as plain as physics goes."""

    kind: str
    values: np.ndarray
    usual: float
    rank: int
    like: tuple[str, ...] = ()

    @property
    def size(self) -> float:
        return float(np.sqrt(np.mean(self.values**2)))

    @property
    def change(self) -> float:
        """Its size about its own mean."""
        return float(np.sqrt(np.mean(np.var(self.values, axis=0))))


class Followed(NamedTuple):
    """`predicted` (6,) share of each channel's squared error on stretches left out (rates x, y, z, velocity x, y, z), `nats` of
    likelihood that it adds there."""

    predicted: np.ndarray
    nats: float


@dataclass(frozen=True)
class Rest:
    """What the dictionary predicts of the rest: `everything` with all regressors that it took, `others` what those add that
    are like no effect of the selection, whose form may be a little off, `strange` those that are like none of the list, `plain`
    the plainest of these; `followed` the regressors, in words, the most telling first; `local`: what is local in frequency or
    in time."""

    everything: Followed
    others: Followed
    strange: Followed
    plain: Followed
    followed: tuple[str, ...]
    local: tuple[str, ...] = ()


def look(evidence: Evidence, selection: Selection) -> Rest:
    """What the dictionary predicts of what the selection leaves."""
    replay = evidence.replay
    tables = [dictionary(t) for t in replay.tracks]
    usual = {n: r.usual for n, r in tables[0].items() if all(n in t for t in tables)}
    sizes = {n: np.sqrt(np.mean([t[n].size ** 2 for t in tables])) for n in usual}
    names = [n for n in usual if _happened([t[n] for t in tables], sizes[n])]
    more = [
        np.stack([channels(track, t[n].kind, t[n].values / max(sizes[n], RARE * usual[n])) for n in names])
        for track, t in zip(replay.tracks, tables, strict=True)
    ]
    table = build(
        replay, selection.fit, {e: f for e, f in testable(evidence).items() if e in selection.effects}, more
    )
    plain = with_effects(table)
    extra = table.more
    spread = np.array([SPREAD * (TORQUE if tables[0][n].kind == "torque" else 1.0) for n in names])
    along = np.array([n in ALONG for n in names])
    carried = widened(plain, extra[along], spread[along] ** -2.0)
    # What pushes along the motion came before it: gusts carry the vehicle with them. What brakes it is an effect.
    pushes = -solve(table, carried)[0, extra] > 0.0
    allowed = (along & pushes) | np.array([n in STEADY for n in names])
    base = widened(plain, extra[allowed], spread[allowed] ** -2.0)
    now = judge(table, base)
    model, then, chosen = base, now, []
    for _ in range(MOST):
        open_ = np.flatnonzero(~allowed & ~np.isin(np.arange(len(names)), chosen))
        nats = offers(table, model, extra[open_], spread[open_] ** -2.0) - then.nats
        best = open_[int(np.argmax(nats.sum(1) - np.maximum(nats.max(1), 0.0)))]
        wider = widened(model, extra[[best]], spread[[best]] ** -2.0)
        whole = judge(table, wider)
        gained = whole.nats - then.nats
        if gained.sum() - max(gained.max(), 0.0) < LEAST_NATS + np.log(len(names)):  # the best of so many
            break
        model, then, chosen = wider, whole, [*chosen, int(best)]
    rank = np.array([_rank(tables[0][n], evidence.library.effects) for n in names])
    taken = np.array(chosen, int)

    own = np.array([bool(set(tables[0][n].like) & set(selection.effects)) for n in names])

    def judged(which):
        columns = taken[which[taken]]
        return judge(table, widened(base, extra[columns], spread[columns] ** -2.0)) if len(columns) else now

    def followed(fewer, more):
        left = fewer.squares.sum(0)
        predicted = np.where(table.usable > 0, 1.0 - more.squares.sum(0) / np.maximum(left, 1e-30), 0.0)
        return Followed(np.maximum(predicted, 0.0), float((more.nats - fewer.nats).sum()))

    known = judged(rank == LIKE_AN_EFFECT)
    disturbed = [
        disturbances(t, r) for t, r in zip(replay.tracks, residuals_of(replay, selection.fit), strict=True)
    ]
    # Feedback answers what isn't known, too: what it did stays in.
    answered = [
        disturbances(t, r)
        for t, r in zip(replay.tracks, residuals_of(replay, selection.fit, ("feedback,",)), strict=True)
    ]
    turned = [np.gradient(t.body_rates, t.dt, axis=0) for t in replay.tracks]
    blind = replay.numbers is SAMPLED_NUISANCES
    heard = replay.usable.copy()
    if any(t.pose_age > 0.0 for t in replay.tracks):
        heard[VELOCITY] = 0.0  # samples put onto faster rows beat with them
    return Rest(
        followed(now, then),
        followed(judged(own & (rank == LIKE_AN_EFFECT)), then),
        followed(known, then),
        followed(known, judged(np.isin(rank, (LIKE_AN_EFFECT, PLAIN)))),
        tuple(names[k] for k in chosen),
        (
            *lines(replay.tracks, disturbed, heard),
            *knocks(replay.tracks, disturbed, replay.usable),
            *torques(replay.tracks, answered, turned, replay.usable, evidence.vehicles, blind),
        ),
    )


def _rank(regressor: Regressor, library: tuple[str, ...]) -> int:
    """A regressor's rank where the list is this one: what is like effects that aren't on it is as plain as any."""
    return PLAIN if regressor.like and not set(regressor.like) & set(library) else regressor.rank


def _happened(regressors: list[Regressor], size: float) -> bool:
    """Whether a regressor can be looked at: one that would be strange must come and go, as what is there all the time may be
    the thrust's, the mass's or a trim's."""
    usual = regressors[0].usual
    if regressors[0].rank == LIKE_AN_EFFECT:
        return size > 1e-3 * usual
    return float(np.sqrt(np.mean([r.change**2 for r in regressors]))) > LEAST_CHANGE * usual


def channels(track: Track, kind: str, values: np.ndarray) -> np.ndarray:
    """Channels (T, 9) of an acceleration (T, 3) of the body frame: "force" m/s^2 or "torque" rad/s^2."""
    if kind == "torque":
        return torque_channels(values, track.dt)
    out = np.zeros((len(track), 9))
    turned = (
        values if track.quaternion is None else np.einsum("tij,tj->ti", rotation(track.quaternion), values)
    )
    out[1:, VELOCITY] = np.cumsum(turned, 0)[:-1] * track.dt
    out[:, FORCE] = values
    return out


def dictionary(track: Track) -> dict[str, Regressor]:
    """{name: regressor} of one track."""
    rows = len(track)
    turn = rotation(track.quaternion) if track.quaternion is not None else np.tile(np.eye(3), (rows, 1, 1))
    velocity = track.velocity if track.velocity is not None else np.zeros((rows, 3))
    v = smooth(np.einsum("tji,tj->ti", turn, velocity), 0.1, track.dt)
    speed = np.linalg.norm(v, axis=1)
    w = smooth(track.body_rates, 0.1, track.dt)
    thrust = smooth(track.motor.mean(1), 0.05, track.dt)
    over = thrust - 0.62
    mix = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]]) / 4.0
    # About their own mean: what is in proportion to the motors is feedback's answer to gusts as well.
    square = smooth((track.motor - track.motor.mean(0)) ** 2 @ mix.T, 0.05, track.dt)
    heading = np.arctan2(turn[:, 1, 0], turn[:, 0, 0])
    time = (track.time - track.time[0]) / 10.0 - 0.5
    out: dict[str, Regressor] = {}

    def add(kind, name, axis, values, usual=1.0, rank=LIKE_AN_EFFECT, like=()):
        vector = values if axis is None else values[:, None] * np.eye(3)[axis]
        out[f"{kind} {'' if axis is None else 'xyz'[axis] + ' '}by {name}"] = Regressor(
            kind, vector, usual, rank, like
        )

    lift, pull = (
        ("thrust_scale", "mass", "thrust_curve", "thrust_saturation", "battery_sag"),
        ("rotor_drag", "blade_flapping", "wind"),
    )
    for axis in (0, 1):
        add("force", "velocity", axis, v[:, axis], like=pull)
        add("force", "velocity squared", axis, v[:, axis] * speed, like=pull)
        add("force", "velocity times thrust", axis, v[:, axis] * over, 0.1, like=pull)
        add("force", "velocity across", axis, v[:, 1 - axis], like=pull)
        add("force", "thrust", axis, thrust, 0.1, STRANGE)
        add("force", f"wind along world {'xy'[axis]}", None, turn[:, axis], like=("wind",))
        add("torque", "velocity", axis, v[:, 1 - axis], like=pull)
        add("torque", "thrust", axis, thrust, like=("com_offset", "motor_imbalance"))
        add("torque", "rates across", axis, w[:, 1 - axis])
        add("torque", "motor commands squared", axis, square[:, axis], 0.01)
        add("torque", "tilt", axis, turn[:, 2, axis], 0.1)
    for name, values, usual, rank, like in (
        ("vertical speed", v[:, 2], 0.3, LIKE_AN_EFFECT, pull),
        ("vertical speed times speed", v[:, 2] * speed, 0.3, LIKE_AN_EFFECT, pull),
        ("horizontal speed", (v[:, :2] ** 2).sum(1), 1.0, PLAIN, ()),
        ("sinking", np.minimum(v[:, 2], 0.0), 0.3, PLAIN, ()),
        ("thrust", over, 0.1, LIKE_AN_EFFECT, lift),
        ("thrust squared", over**2, 0.02, LIKE_AN_EFFECT, lift),
        ("high motor commands", np.maximum(track.motor - 0.75, 0.0).mean(1), 0.03, LIKE_AN_EFFECT, lift),
        ("time", time, 0.3, PLAIN, ()),
    ):
        add("force", name, 2, values, usual, rank, like)
    for axis in range(3):
        add("torque", "time", axis, time, 0.3, PLAIN)
    add("torque", "rates x", 2, w[:, 0], 1.0, STRANGE)
    add("torque", "rates y", 2, w[:, 1], 1.0, STRANGE)
    add("torque", "thrust", 2, thrust)
    add("torque", "motor commands squared", 2, square[:, 2], 0.01)
    add("torque", "heading, sine", 2, np.sin(heading), 1.0, STRANGE)
    add("torque", "heading, cosine", 2, np.cos(heading), 1.0, STRANGE)
    add("torque", "change of thrust", 2, np.gradient(thrust, track.dt))
    if track.voltage is not None:
        add("force", "voltage", 2, track.voltage - 3.8, 0.1, like=("battery_sag",))
    if track.position is not None:
        place = track.position - [0.0, 0.0, 0.6]
        height = np.maximum(track.position[:, 2], 0.0)
        for axis in range(3):
            for own in range(3):
                pull = place[:, own : own + 1] * turn[:, axis]
                # Wind may change with height; a spring pulls back along each axis.
                rank = PLAIN if own == axis else LIKE_AN_EFFECT if own == 2 else STRANGE
                add("force", f"place {'xyz'[own]} along world {'xyz'[axis]}", None, pull, 0.3, rank)
        add("force", "the floor near", 2, (RADIUS / (height + 0.03)) ** 2, 0.1, like=("ground_effect",))
        ceiling = np.maximum(ARENA_CEILING - height, 0.0)
        add("force", "the ceiling near", 2, (RADIUS / (ceiling + 0.05)) ** 2, 0.1, like=("ceiling_effect",))
        for x in (-0.5, 0.0, 0.5):
            for y in (-0.5, 0.0, 0.5):
                bump = np.exp(-((place[:, 0] - x) ** 2 + (place[:, 1] - y) ** 2) / (2 * WIDTH**2))
                add("force", f"the place ({x:g}, {y:g})", 2, bump, 0.3, STRANGE)
                for axis in (0, 1):
                    name = f"the place ({x:g}, {y:g}) along world {'xy'[axis]}"
                    add("force", name, None, bump[:, None] * turn[:, axis], 0.3, STRANGE)
        for k, other in enumerate(track.neighbours):
            gap = other - track.position
            below = (gap[:, 2] > 0.02) * np.exp(-np.maximum(gap[:, 2], 0.0) / 0.5)
            for width in (0.05, 0.15):
                near = below * np.exp(-(gap[:, 0] ** 2 + gap[:, 1] ** 2) / (2 * width**2))
                add("force", f"vehicle {k} above, {width:g} m", 2, near, 0.1, like=("downwash",))
    return out


def residuals_of(replay: Replay, fit: SetFit, kept=()) -> list[np.ndarray]:
    """Residual (T, 9) of each track under a fit, nuisances taken off but those whose names begin like `kept`."""
    stay = np.array([n.startswith(tuple(kept)) for n in replay.nuisance_names])
    return [without_nuisances(replay, column[0], number, stay) for number, column in enumerate(fit.columns)]


def disturbances(track: Track, residual: np.ndarray) -> np.ndarray:
    """The rest as accelerations (T, 9): angular (body), linear (body, from the velocity), specific force (body)."""
    out = np.zeros_like(residual)
    out[:, RATES] = np.gradient(residual[:, RATES], track.dt, axis=0)
    world = np.gradient(residual[:, VELOCITY], track.dt, axis=0)
    turn = (
        rotation(track.quaternion) if track.quaternion is not None else np.tile(np.eye(3), (len(track), 1, 1))
    )
    out[:, VELOCITY] = np.einsum("tji,tj->ti", turn, world)
    out[:, FORCE] = residual[:, FORCE]
    return out
