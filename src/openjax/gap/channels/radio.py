"""The radio: delay and lost packets of the commands, read without any dynamics.

The mean of the motor commands is the commanded thrust, so its delay and its lost
packets show row by row.
"""

from dataclasses import dataclass

import numpy as np

from openjax.flights.grid import held_means
from openjax.flights.track import Track
from openjax.gap.channels import Channel, Estimated, few
from openjax.gap.decision import DECISION
from openjax.gap.model.library import CARDS

LONGEST_DELAY = 0.1  # s
DELAY_STEP = 0.0005  # s
TOLERANCE = 3e-4  # of thrust: rounding of the logs and of the firmware's integers
# smallest change of commanded thrust that shows what the link does at all
INFORMATIVE = 1.5e-3
# of the way from the command held to the one due: up to HELD it is held, up to BETWEEN
# neither
HELD = 0.2
BETWEEN = 0.6
DEPENDENT = 3.0  # rows that count as one independent error
# of a row, by which a delay is known where rows are means, and where they are single
# samples: the deviation of a uniform distribution over one row is 1 / sqrt(12) of it
ROW_ERROR = (0.1, 0.29)

# the parameters of the effects that a radio tells
DELAY = "delay"
LOSS = "probability"


@dataclass(frozen=True, eq=False)
class Link:
    """The link under one hypothesis. The last four are (tracks,) numbers of rows."""

    arrivals: list
    """[(fraction, (T, 2) rows)]: of each track the command in force at the end and at
    the start of each row, and the share of the row that the older one rules.
    """
    error: np.ndarray
    """(M,) of the collective thrust."""
    informative: np.ndarray
    """With a new command."""
    telling_rows: np.ndarray
    """So clear that they tell whether it arrived."""
    lost_rows: np.ndarray
    """In which it didn't."""
    ambiguous_rows: np.ndarray
    """That neither hold the old command nor follow the new one."""

    @property
    def misfit(self) -> float:
        """Mean error of the collective thrust."""
        return float(np.mean(np.abs(self.error))) if len(self.error) else 0.0

    @property
    def nats(self) -> float:
        """Log-likelihood of the errors under a Laplace distribution of unknown
        scale.
        """
        return -len(self.error) / DEPENDENT * float(np.log(self.misfit + TOLERANCE))


@dataclass(frozen=True, eq=False)
class Radio(Channel):
    """Losses and delays of commands on their way to the vehicle."""

    delay: float  # s
    links: dict[frozenset, Link]
    """{parameters that aren't nominal: the link}"""
    names: dict[str, str]
    """{parameter: effect} of the library."""
    row: float = 0.01  # s
    single_samples: bool = False
    """True if a row's motors are one sample."""
    path = "radio"

    @property
    def losing(self) -> Link:
        """The link that loses packets, at the delay found."""
        return self.links[frozenset({DELAY, LOSS} if self.delay > 0 else {LOSS})]

    @property
    def loss(self) -> float:
        """Share of the packets that were lost."""
        return float(self.losing.lost_rows.sum() / max(self.losing.telling_rows.sum(), 1))

    @property
    def readable(self) -> bool:
        """True if the motors' stream follows the commands closely enough to tell single packets."""
        return self.links[frozenset({DELAY, LOSS})].misfit < DECISION.link_misfit

    @property
    def off_nominal(self) -> frozenset:
        """The parameters that aren't nominal: each must gain beside the other, exceed
        what clocks may differ by, or a share of lost packets. Packets aren't lost where
        as many rows lie between two commands: a delay that jitters leaves those.
        """
        if not self.readable:
            return frozenset()
        both = frozenset({DELAY, LOSS})
        gain = {p: self.links[both].nats - self.links[both - {p}].nats for p in both}
        late = self.delay > DECISION.clock and gain[DELAY] > DECISION.link_nats
        loses = (
            self.loss > DECISION.packet_loss
            and gain[LOSS] > DECISION.link_nats
            and self.losing.ambiguous_rows.sum() < 0.5 * self.losing.lost_rows.sum()
        )
        return frozenset(p for p, on in ((DELAY, late), (LOSS, loses)) if on and p in self.names)

    @property
    def arrivals(self) -> list:
        """The commands that the link let through."""
        return self.links[self.off_nominal].arrivals

    def acting(self) -> dict[str, float]:
        return {self.names[p]: 1.0 - DECISION.unknown for p in sorted(self.off_nominal)}

    def undetectable(self) -> list[str]:
        changes = self.links[frozenset({DELAY, LOSS})].informative.sum()
        changes_enough = changes >= DECISION.link_changes
        return [] if self.readable and changes_enough else list(self.names.values())

    def estimate(self, effect: str, parameter: str) -> Estimated:
        if parameter == DELAY:
            error = float(np.hypot(DELAY_STEP, ROW_ERROR[self.single_samples] * self.row))
            return Estimated(self.delay, error, error)
        link = self.links[frozenset({DELAY, LOSS})]
        packets = max(link.telling_rows.sum(), 1)
        each = link.lost_rows / np.maximum(link.telling_rows, 1)
        # Packets are lost in bursts: how much flights differ tells more than how many
        # there were.
        apart = few(len(each)) * each.std(ddof=1) / np.sqrt(len(each)) if len(each) > 1 else 0.0
        error = float(
            np.hypot(np.sqrt(self.loss * (1 - self.loss) / packets), apart) + 0.5 / packets
        )
        return Estimated(self.loss, error, error)

    def residuals(self, effects) -> dict[str, list[np.ndarray]]:
        link = self.links[frozenset(p for p, effect in self.names.items() if effect in effects)]
        return {"motors all": [np.array([np.hypot(link.misfit, TOLERANCE)]) for _ in link.arrivals]}


def read_radio(tracks: list[Track], library, single_samples: bool = False) -> Radio:
    """Delay and lost packets from the commanded thrust against the mean of the motor
    commands.
    """
    delays = np.arange(0.0, LONGEST_DELAY, DELAY_STEP)
    misfit = sum(_delay_misfit(track, delays) for track in tracks)
    delay = float(delays[int(np.argmin(misfit))])
    links = {
        frozenset(): _decode(tracks, 0.0, may_lose=False),
        frozenset({LOSS}): _decode(tracks, 0.0, may_lose=True),
        frozenset({DELAY}): _decode(tracks, delay, may_lose=False),
        frozenset({DELAY, LOSS}): _decode(tracks, delay, may_lose=True),
    }
    names = {CARDS[e].fitted[0].name: e for e in library.of("radio")}
    return Radio(delay, links, names, max(t.dt for t in tracks), single_samples)


def _clean_rows(track: Track) -> np.ndarray:
    """(T,) rows in which no motor is at its limits, where their mean isn't the
    commanded thrust; without the first, before which commands aren't known.
    """
    clean = ((track.motor < 0.997) & (track.motor > 0.003)).all(1)
    clean[: int(LONGEST_DELAY / track.dt) + 2] = False
    return clean


def _delay_misfit(track: Track, delays: np.ndarray) -> np.ndarray:
    """(D,) sums of a track's errors of the thrust under each of the delays (D,)."""
    thrust = track.command[:, 0]
    clean = _clean_rows(track)
    # a lost packet must not pull at the delay
    cap = 0.3 * np.std(np.diff(thrust)) + 1e-9

    def misfit(delay):
        error = np.abs(_late_error(track, delay)[clean])
        return np.minimum(error, cap).sum()

    return np.array([misfit(delay) for delay in delays])


def _late_error(track: Track, delay: float) -> np.ndarray:
    """(T,) mean of the motors less the commanded thrust of `delay` s ago."""
    whole, part, motors, _ = _link_rows(track, delay)
    thrust = track.command[:, 0]
    return motors - (1 - part) * _late(thrust, whole) - part * _late(thrust, whole + 1)


def _late(values: np.ndarray, rows: int) -> np.ndarray:
    """Values so many rows later, the first one before."""
    return np.concatenate([np.repeat(values[:1], rows, 0), values[: len(values) - rows]])


def _rows_late(track: Track, delay: float) -> tuple[int, float]:
    """A delay (s) in rows: whole ones and the rest."""
    # a delay of whole rows stays so, whatever a quotient of floats makes of it
    whole = int(delay / track.dt + 1e-9)
    return whole, delay / track.dt - whole


def _link_rows(track: Track, delay: float) -> tuple[int, float, np.ndarray, np.ndarray]:
    """Rows in which commands of `delay` s ago are in force: whole rows late, the share
    of a row that the one before still rules, the motors' mean (T,), whether it can be
    read (T,). Logs faster than the rows are cut anew where the commands arrive, so that
    a row holds one command.
    """
    clean = _clean_rows(track)
    if track.fast_thrust is None:
        whole, part = _rows_late(track, delay)
        return whole, part, track.motor.mean(1), clean
    times, thrust = track.fast_thrust
    motors = held_means(times, thrust, track.time + delay, track.dt)
    rows = int(np.ceil(delay / track.dt - 1e-9))
    for shift in range(1, rows + 1):  # what a row holds then is in these
        clean = clean & np.concatenate([clean[shift:], np.zeros(min(shift, len(clean)), bool)])
    return 0, 0.0, motors, clean


def _decode(tracks, delay: float, may_lose: bool) -> Link:
    """Row by row: did the command due in this row arrive, or is the one before still
    held?
    """
    errors = []
    arrivals = []
    counts = []
    for track in tracks:
        in_force, error, row_counts = _follow(track, delay, may_lose)
        errors.append(error)
        counts.append(row_counts)
        whole, part = _rows_late(track, delay)
        in_force = in_force if track.fast_thrust is None else _late(in_force, whole)
        arrivals.append((part, np.stack([in_force, _late(in_force, 1)], 1)))
    informative, telling, losses, between = np.array(counts).T
    return Link(arrivals, np.concatenate(errors), informative, telling, losses, between)


def _follow(track: Track, delay: float, may_lose: bool):
    """Row of the command in force (T,), errors of the thrust in clean rows, and how
    many rows are informative, telling, lost, ambiguous.
    """
    whole, part, motors, clean = _link_rows(track, delay)
    error = np.abs(_late_error(track, delay)[clean])
    noise = float(np.median(error)) if len(error) else 0.0
    # least change of thrust that shows whether a packet arrived
    telling = (TOLERANCE + 2.0 * noise) / HELD
    thrust = track.command[:, 0].tolist()
    motors = motors.tolist()
    flags = clean.tolist()
    last = 0
    in_force = np.zeros(len(track), int)
    error = np.zeros(len(track))
    counts = np.zeros(4, int)
    for row in range(len(track)):
        due = max(row - whole, 0)
        due_thrust = (1 - part) * thrust[due] + part * thrust[last]
        change = abs(thrust[last] - due_thrust)
        is_lost = False
        if flags[row] and change > INFORMATIVE:
            way = abs(motors[row] - thrust[last]) / change
            is_lost = may_lose and way < abs(motors[row] - due_thrust) / change
            tells = change > telling
            counts += [1, tells, tells and way < HELD, tells and HELD <= way < BETWEEN]
        error[row] = motors[row] - (thrust[last] if is_lost else due_thrust)
        last = last if is_lost else due
        in_force[row] = last
    return in_force, error[clean], counts
