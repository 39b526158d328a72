"""Numbers of the vehicle's torques, and the clock of its motors."""

from dataclasses import replace

from openjax.flights.track import Track
from openjax.gap.decision import DECISION
from openjax.gap.identification.prediction_errors import Problem, earlier
from openjax.gap.identification.row_errors import HALF_CYCLE
from openjax.gap.identification.search import TorqueFit, begin, earliest, search

FAST_ROWS = 0.005  # s: slower rows show 2 ms of delay in its place
AHEAD = (0.006, 0.012, 0.02, 0.04, 0.08)  # s by which motors are tried earlier than logged
LATE = (0.002, 0.03)  # s, starts of the delay


def identify_torques(records: list[Track], one_clock: bool = True) -> TorqueFit:
    """The most likely fit of records with body rates, over the motors' clock as well;
    where streams share no `one_clock`, none is looked for.
    """
    base = Problem(records)
    fits = _first_fits(base)
    if base.dt < FAST_ROWS:
        # Whether such rows are of the filtered gyroscope nobody says, but they show it.
        low_pass_problem = Problem(records, low_pass=True)
        others = _first_fits(low_pass_problem)
        if _best(base, others).loss < _best(base, fits).loss - DECISION.clock_nats:
            base, fits = low_pass_problem, others
    first = _best(base, fits)
    is_late = all(_begins(base, rows, fit) for rows, fit in fits.items())
    if not one_clock or (_clear(first) and not is_late):
        return first
    late = search(base, begin(base, LATE[1]))
    fits[0] = min(fits[0], late, key=lambda f: f.loss)
    for seconds in AHEAD:
        rows = round(seconds / base.dt)
        if rows not in fits:
            fits[rows] = _earlier_fit(base, rows)
    return _best(base, fits)


def _first_fits(base: Problem) -> dict[int, TorqueFit]:
    """{rows by which motors are earlier: the fit from a usual delay}. Motors that were
    logged too late hold the search at its beginning, with lags and gains too small, so it
    goes on before that. Where rows show each cycle of the rate loop it may be held further
    on, with slow and weak motors, so it begins earlier there in any case.
    """
    rows = 0
    fits = {rows: search(base, begin(base, LATE[0]))}
    hides_ticks = base.records[0].hides_ticks
    for seconds in AHEAD[:2]:
        if (hides_ticks or rows) and not _begins(base, rows, fits[rows]):
            break
        rows = max(round(seconds / base.dt), 1)
        if rows not in fits:
            fits[rows] = _earlier_fit(base, rows)
    return fits


def _best(base: Problem, fits: dict[int, TorqueFit]) -> TorqueFit:
    """The likeliest of those that don't end at the beginning of their search, if there are
    such: what rows hide counts for motors that act before they are logged.
    """
    return fits[min(fits, key=lambda rows: (_begins(base, rows, fits[rows]), fits[rows].loss))]


def _begins(base: Problem, rows: int, fit: TorqueFit) -> bool:
    """True if a fit with motors so many rows earlier ends at the beginning of its search,
    and the motors' clock may lie before that.
    """
    return fit.clock + rows * base.dt < earliest(base.records[0]) + HALF_CYCLE


def _earlier_fit(base: Problem, rows: int) -> TorqueFit:
    """The fit with motors so many rows earlier than logged."""
    problem = Problem([earlier(r, rows) for r in base.records], base.low_pass)
    fit = search(problem, begin(problem, LATE[0]))
    value = fit.value.copy()
    value[2] -= rows * base.dt
    loss = _comparable(fit.loss, problem, base) + DECISION.clock_nats
    return replace(fit, value=value, loss=loss)


def _comparable(loss: float, problem: Problem, base: Problem) -> float:
    """A shifted log's loss as if it had as many rows as the whole one."""
    return (loss + problem.surprise) * base.count / problem.count - base.surprise


def _clear(fit: TorqueFit) -> bool:
    """True if roll and pitch answer as strongly and as soon as those of any such
    vehicle: then the rows' clock is right to a few milliseconds, and no other need be
    tried.
    """
    is_strong = fit.value[3:5].min() > DECISION.strong_gain
    return bool(is_strong and fit.value[:2].max() < DECISION.slow_lag)
