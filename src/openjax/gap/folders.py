"""The answer to a folder of flights: a diagnosis, with a reference where folders of
earlier days are given, and what trims alone say beside it or in its place.
"""

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from openjax.errors import TooLittle
from openjax.flights.case import read_folder
from openjax.flights.flight import Case
from openjax.gap.diagnosis import diagnose_case
from openjax.gap.planning.beliefs import next_flight
from openjax.gap.report import Report
from openjax.gap.trims import Change, compare


def diagnose_folder(
    folder: Path, reference: Sequence[Path] = (), without: Iterable[str] = (), progress=None
) -> Report | Change:
    """Diagnose the flights of a folder.

    Args:
      folder: logs and a `vehicle.toml`.
      reference: folders of flights of the same vehicle while nothing was wrong with it,
        one for each day; told is then what changed since.
      without: effects that the library must do without.
      progress: called with a text as the work goes on.

    Returns:
      A report, with what trims say of a change in it. Where there is a reference, and
      most flights hold too little for a diagnosis: what trims alone say.

    Raises:
      UserError: nothing can be said, or the folders are of several vehicles.
    """
    trims = None
    logs = read_folder(folder)
    logs_before = [read_folder(day) for day in reference]
    if logs_before:
        with suppress(TooLittle):  # a diagnosis may still be made
            trims = compare(logs, logs_before)
    try:
        case = logs.case()
        if trims is not None:
            _check_that_most_show_more(case, trims)
        days = [day.case() for day in logs_before]
        report = diagnose_case(case, without, progress, days, trims)
    except TooLittle as error:
        if trims is None:
            raise
        return replace(trims, alone_because=str(error).removeprefix(f"{folder}: "))
    vehicle_file = case.vehicle_file
    if progress:
        progress("asking which flight would tell most")
    return replace(
        report,
        vehicle="" if vehicle_file.path is None else str(vehicle_file.path.resolve()),
        next_flight=next_flight(report.to_dict(), vehicle_file),
    )


def _check_that_most_show_more(case: Case, trims: Change) -> None:
    """Raise TooLittle where most flights hold no more than motors: what days do to trims
    is then known from all of them, and a diagnosis would be one of the others.
    """
    few = len(case.flights)
    number = len(trims.flights)
    if 2 * few < number:
        raise TooLittle(f"{few} of {number} flights hold{'s' * (few == 1)} more than motors")
