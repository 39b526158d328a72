"""Numbers of the vehicle's torques, and the clock of its motors."""

from dataclasses import replace

from openjax.flights.track import Track
from openjax.gap.identification.prediction_errors import Problem, earlier
from openjax.gap.identification.search import TorqueFit, begin, search

FAST_ROWS = 0.005  # s: slower rows show 2 ms of delay in its place
AHEAD = (0.01, 0.02, 0.04, 0.08)  # s by which motors are tried earlier than logged
LATE = (0.002, 0.03)  # s, starts of the delay
# of the nominal gain; the heaviest decks and duty cycles leave about as much
STRONG = 0.45
SOON = 0.12  # s; the slowest motors that fly
CLEARLY = 10.0  # nats by which motors logged too late must be better


def identify_torques(records: list[Track], one_clock: bool = True) -> TorqueFit:
    """The most likely fit of records with body rates, over the motors' clock as well;
    where streams share no `one_clock`, none is looked for.
    """
    base = Problem(records)
    first = search(base, begin(base, LATE[0]))
    if base.dt < FAST_ROWS:
        # Whether such rows are of the filtered gyroscope nobody says, but they show it.
        low_pass_problem = Problem(records, low_pass=True)
        other = search(low_pass_problem, begin(low_pass_problem, LATE[0]))
        if other.loss < first.loss - CLEARLY:
            base, first = low_pass_problem, other
    if _clear(first) or not one_clock:
        return first
    fits = [first, search(base, begin(base, LATE[1]))]
    for rows in {round(ahead / base.dt): None for ahead in AHEAD}:
        if rows:
            problem = Problem([earlier(r, rows) for r in records], base.low_pass)
            fit = search(problem, begin(problem, LATE[0]))
            value = fit.value.copy()
            value[2] -= rows * base.dt
            loss = _comparable(fit.loss, problem, base) + CLEARLY
            fits.append(replace(fit, value=value, loss=loss))
    return min(fits, key=lambda f: f.loss)


def _comparable(loss: float, problem: Problem, base: Problem) -> float:
    """A shifted log's loss as if it had as many rows as the whole one."""
    return (loss + problem.surprise) * base.count / problem.count - base.surprise


def _clear(fit: TorqueFit) -> bool:
    """Whether roll and pitch answer as strongly and as soon as those of any such
    vehicle: then the rows' clock is right to a few milliseconds, and no other need be
    tried.
    """
    return bool(fit.value[3:5].min() > STRONG and fit.value[:2].max() < SOON)
