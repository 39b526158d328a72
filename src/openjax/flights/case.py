"""Loading a case: every log of a folder is read, checked and either kept or refused
with the reason.
"""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from openjax.errors import TooLittle, UserError
from openjax.flights.agreement import shown_right
from openjax.flights.checks import check_flight, duplicates
from openjax.flights.flight import Case, Flight, Issue
from openjax.flights.importers import (
    MAPPING_FILE,
    ColumnMapping,
    find_logs,
    importers,
    load_mapping,
    read_log,
)
from openjax.flights.plausible import wrong_mass
from openjax.flights.reading import LogError, flights_of
from openjax.flights.together import Logs, join
from openjax.vehicle.parameters import NOMINAL
from openjax.vehicle.vehicle_file import VehicleFile, load_vehicle_file

NO_LOGS = ("vehicle.toml", MAPPING_FILE)
FLIGHT_FILE = "flight.json"  # beside the logs of openjax fly
SHOWN = 3  # files that are named where none is a log


@dataclass(frozen=True, eq=False)
class LogFolder:
    """A folder of logs as they were read, not yet checked."""

    path: Path
    vehicle_file: VehicleFile
    """Of the nominal vehicle where the folder has none."""
    has_vehicle_file: bool
    logs: Logs

    def case(self, comparison: bool = False) -> Case:
        """Checked, as `load_case` says."""
        if not self.has_vehicle_file and not comparison:
            raise TooLittle(f"{self.path}: no vehicle.toml; {_called_otherwise(self.path)}")
        vehicle_file, logs, issues = _with_motor_commands(self.vehicle_file, self.logs)
        flights, findings = _usable(logs, vehicle_file, comparison)
        issues += [*findings, *_not_flown(vehicle_file, self.logs)]
        if not flights:
            reasons = [i for i in issues if i.refused]
            first = (
                f"{reasons[0].flight}: {reasons[0].issue}" if reasons else "no vehicle in any log"
            )
            more = f" (and {len(reasons) - 1} more)" if len(reasons) > 1 else ""
            raise TooLittle(f"{self.path}: no flight can be used: {first}{more}")
        # A thrust error is told from the mass only where every vehicle that flew was weighed.
        is_weighed = all(vehicle_file.mass_weighed_of(flight.vehicle) for flight in flights)
        vehicle_file = replace(vehicle_file, mass_weighed=is_weighed)
        name = self.path.resolve().name
        return Case(name, tuple(flights), vehicle_file, tuple(issues), self.path)


def load_case(path: str | Path, dtype=jnp.float32, comparison: bool = False) -> Case:
    """Read a case folder: its `vehicle.toml` and its logs (of any format that is
    known). For a `comparison` with other flights motor commands alone are enough, and
    without a vehicle file the nominal vehicle is taken.

    Logs that can't be used are left out and named in `quality` (`refused`). Raises
    UserError for a folder without logs or an unusable vehicle file, and of that
    TooLittle if there is no vehicle file or no log is left.
    """
    return read_folder(path, dtype).case(comparison)


def read_folder(path: str | Path, dtype=jnp.float32) -> LogFolder:
    """Read a folder for one case or several, as `load_case` does."""
    path = Path(path)
    if not path.is_dir():
        what = "is a file" if path.exists() else "no such folder"
        raise UserError(f"{path}: {what}; a case is a folder of flight logs with a vehicle.toml")
    logs = find_logs(path)
    if not logs:
        raise UserError(f"{path}: holds no flight log{_held_instead(path)}{_cases_inside(path)}")
    has_vehicle_file = (path / "vehicle.toml").exists()
    vehicle_file = load_vehicle_file(path / "vehicle.toml" if has_vehicle_file else None, dtype)
    mapping = load_mapping(path / MAPPING_FILE) if (path / MAPPING_FILE).exists() else None
    logs_read, issues = join(tuple(_read(log, vehicle_file, mapping) for log in logs))
    return LogFolder(path, vehicle_file, has_vehicle_file, (*logs_read, ([], issues)))


def _with_motor_commands(
    vehicle_file: VehicleFile, logs: Logs
) -> tuple[VehicleFile, Logs, list[Issue]]:
    """The vehicle file with what its motors' commands are, the logs that they are so in,
    and what was found: where it doesn't say, the logs' format may.
    """
    if vehicle_file.motor.command is not None:
        return vehicle_file, logs, []
    with_motors = [f for flights, _ in logs for f in flights if f.motor_command is not None]
    # the public map from duty cycles to thrust is that of the brushed vehicle
    duty = {f.log for f in with_motors if f.duty_cycles and vehicle_file.airframe == NOMINAL}
    shares = {f.log for f in with_motors} - duty
    command = "pwm" if duty and not shares else "thrust"
    vehicle_file = replace(vehicle_file, motor=replace(vehicle_file.motor, command=command))
    if command == "pwm":
        words = 'motors are duty cycles, as the firmware logs them: motor.command = "pwm"'
        return vehicle_file, logs, [Issue("vehicle.toml", words, kind="motors")]
    words = "motors are duty cycles, and shares of the thrust in other logs: two cases, or say "
    issues = [
        Issue(log, f"{words}motor.command in vehicle.toml", refused=True, kind="motors")
        for log in sorted(duty)
    ]
    rest = tuple(([f for f in of_log if f.log not in duty], findings) for of_log, findings in logs)
    return vehicle_file, rest, issues


def _not_flown(vehicle_file: VehicleFile, logs_read) -> list[Issue]:
    """Issues about vehicles of the vehicle file that are in none of the logs: an id with
    another spelling, whose mass would go unnoticed.
    """
    vehicles = sorted({flight.vehicle for flights, _ in logs_read for flight in flights})
    others = sorted(set(vehicle_file.vehicles) - set(vehicles))
    if not others or not vehicles:
        return []
    tables = ", ".join(f"[vehicles.{name}]" for name in others)
    text = f"{tables}: no log is of such a vehicle; they are of {', '.join(vehicles)}"
    return [Issue("vehicle.toml", text, kind="vehicle")]


def _held_instead(path: Path) -> str:
    """A folder's content without a log, in words, and the known kinds of logs."""
    if (path / FLIGHT_FILE).exists():
        return f": openjax fly wrote it, and no game was flown; {FLIGHT_FILE} says why"
    others = sorted(file.name for file in path.iterdir() if file.name not in NO_LOGS)
    formats = f"known are {', '.join(importer.name for importer in importers())}"
    listing = ", ".join(others[:SHOWN]) + f" and {len(others) - SHOWN} more" * (len(others) > SHOWN)
    return f": {formats}; it holds {listing}" if others else f"; {formats}"


def _called_otherwise(path: Path) -> str:
    """Advice for a folder without a vehicle.toml: an editor may have called it Vehicle.toml or
    vehicle.toml.txt.
    """
    names = sorted(file.name for file in path.iterdir())
    for name in names:
        if name.lower().startswith("vehicle.t"):
            return f"if {name} is meant, rename it"
    return "an empty one there means the nominal Crazyflie"


def _cases_inside(path):
    """In words: which cases a folder holds, where somebody gave the one above."""
    cases = sorted(file.parent.name for file in path.glob("*/vehicle.toml"))
    return f"; cases inside it: {cases[0]} ({len(cases)} in all)" if cases else ""


def _usable(
    logs_read, vehicle_file: VehicleFile, comparison: bool
) -> tuple[list[Flight], list[Issue]]:
    """Of the logs that were read the flights that can be used, checked and mended, and
    what was found.
    """
    flights = [flight for of_log, _ in logs_read for flight in of_log]
    issues = [issue for _, of_log in logs_read for issue in of_log]
    # a copy would count as evidence twice
    copies = duplicates(flights)
    for name, original in copies.items():
        text = f"the same values as {original}: a copy, left out"
        issues.append(Issue(name, text, refused=True, kind="duplicate"))
    results = [_check(f, vehicle_file, comparison) for f in flights if f.log not in copies]
    issues += [issue for _, of_flight in results for issue in of_flight]
    usable, refusals = _without_distrust(
        [f for f, _ in results if f is not None], issues, vehicle_file
    )
    return usable, issues + refusals


def _without_distrust(
    flights: list[Flight], issues: list[Issue], vehicle_file: VehicleFile
) -> tuple[list[Flight], list[Issue]]:
    """The flights without those that are too calm to show what most others contradict:
    columns are mixed up for a case.
    """
    failures = Counter(what for issue in issues for what in issue.against)
    if not failures:
        return flights, []
    channels = [shown_right(f, vehicle_file.vehicle_of(f.vehicle)) for f in flights]
    counts = Counter(what for flight in channels for what in flight)
    out = []
    refusals = []
    for flight, right in zip(flights, channels, strict=True):
        doubts = [what for what in failures if what not in right and failures[what] > counts[what]]
        if not doubts:
            out.append(flight)
        else:
            text = (
                f"other flights of the case contradict {doubts[0]}, and this one is too calm to be "
                "checked"
            )
            refusals.append(Issue(flight.name, text, refused=True, kind="garbage"))
    return out, refusals


def _check(
    flight: Flight, vehicle_file: VehicleFile, comparison: bool
) -> tuple[Flight | None, list[Issue]]:
    """One flight checked and mended, None where it can't be used, and what was found."""
    vehicle = vehicle_file.vehicle_of(flight.vehicle)
    try:
        usable, issues = check_flight(flight, vehicle, vehicle_file.log, comparison)
        wrong = "" if usable is None or comparison else wrong_mass(usable, vehicle)
        if wrong:
            issues = [*issues, Issue(flight.name, wrong, refused=True, kind="vehicle")]
        return None if wrong else usable, issues
    except (ArithmeticError, ValueError, IndexError, np.linalg.LinAlgError) as error:
        # Values that no check has foreseen: this flight can't be used, the others can.
        text = f"can't be checked ({type(error).__name__}: {error})".split("\n")[0]
        return None, [Issue(flight.name, text, refused=True, kind="corrupt")]


def _read(
    log: Path, vehicle_file: VehicleFile, mapping: ColumnMapping | None
) -> tuple[list[Flight], list[Issue]]:
    """The flights of one log, and what was found."""
    try:
        flights, remarks = flights_of(read_log(log, mapping), vehicle_file.motor_permutation)
    except LogError as error:
        return [], [Issue(log.name, str(error), refused=True, kind="reading")]
    return flights, [Issue(log.name, remark, kind="columns") for remark in remarks]
