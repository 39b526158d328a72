"""Numbers of the vehicle's torques, and the clock of its motors."""

from dataclasses import replace

from openjax.flights.track import Track
from openjax.gap.identification.prediction_errors import Problem, earlier
from openjax.gap.identification.row_errors import HALF_CYCLE
from openjax.gap.identification.search import TorqueFit, begin, search

FAST_ROWS = 0.005  # s: slower rows show 2 ms of delay in its place
AHEAD = (0.006, 0.012, 0.02, 0.04, 0.08)  # s by which motors are tried earlier than logged
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
    first = _first_fit(base)
    if base.dt < FAST_ROWS:
        # Whether such rows are of the filtered gyroscope nobody says, but they show it.
        low_pass_problem = Problem(records, low_pass=True)
        other = _first_fit(low_pass_problem)
        if other.loss < first.loss - CLEARLY:
            base, first = low_pass_problem, other
    if _clear(first) or not one_clock:
        return first
    fits = [first, search(base, begin(base, LATE[1]))]
    fits += [_earlier_fit(base, rows) for rows in {round(s / base.dt): None for s in AHEAD} if rows]
    return min(fits, key=lambda f: f.loss)


def _first_fit(base: Problem) -> TorqueFit:
    """The fit from a usual delay. Where rows show each cycle of the rate loop, motors that
    were logged some cycles too late hold the search in a place with slow and weak ones, so
    it begins before them as well, and earlier still where it ends at its beginning.
    """
    fits = [search(base, begin(base, LATE[0]))]
    if not base.records[0].hides_ticks:
        for cycles in AHEAD[:2]:
            fits.append(_earlier_fit(base, round(cycles / base.dt)))
            if fits[-1].clock > HALF_CYCLE - cycles:
                break
    return min(fits, key=lambda f: f.loss)


def _earlier_fit(base: Problem, rows: int) -> TorqueFit:
    """The fit with motors so many rows earlier than logged."""
    problem = Problem([earlier(r, rows) for r in base.records], base.low_pass)
    fit = search(problem, begin(problem, LATE[0]))
    value = fit.value.copy()
    value[2] -= rows * base.dt
    return replace(fit, value=value, loss=_comparable(fit.loss, problem, base) + CLEARLY)


def _comparable(loss: float, problem: Problem, base: Problem) -> float:
    """A shifted log's loss as if it had as many rows as the whole one."""
    return (loss + problem.surprise) * base.count / problem.count - base.surprise


def _clear(fit: TorqueFit) -> bool:
    """True if roll and pitch answer as strongly and as soon as those of any such
    vehicle: then the rows' clock is right to a few milliseconds, and no other need be
    tried.
    """
    return bool(fit.value[3:5].min() > STRONG and fit.value[:2].max() < SOON)
