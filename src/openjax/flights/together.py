"""Vehicles of one flight whose logs are files of their own, as cards and loggers write
them: joined where their clocks allow it, else told.

Their files' names hold a vehicle's id (`flight_a_cf1`, `cf2_log03`). Stamps since 1970 are
those of the computers that wrote them, and say who flew together. A CSV of the log format
counts its time from the flight's start, which is the same for all whose names differ by the
id alone. Ticks of each vehicle's firmware are no common clock.
"""

import dataclasses
import itertools
import re
from collections import defaultdict
from pathlib import Path

from openjax.flights.flight import Flight, Issue

Logs = tuple[tuple[list[Flight], list[Issue]], ...]
"""The flights of each log, and what was found while it was read."""

KINDS = "cf|crazyflie|drone|uav|quad|quadrotor|vehicle|robot|agent|mav"
ID = re.compile(rf"(?<![a-z0-9])((?:{KINDS})[_-]?\d+)(?![a-z0-9])", re.IGNORECASE)
"""A vehicle's id in a file's name."""
SINCE_1970 = 1e9  # s, from which stamps count since then: the year 2001
FLIGHT_BEGINS = 1.0  # s: clocks that read less count from the flight's start
OVERLAP = 0.5  # share of the shorter flight in which both fly


def join(logs: Logs) -> tuple[Logs, list[Issue]]:
    """The logs with vehicles that flew together as flights of one log, and what was found."""
    single = [flights[0] for flights, _ in logs if len(flights) == 1]
    issues = []
    changes: dict[str, Flight] = {}
    for log, group in _of_one_time([f for f in single if _begin(f) > SINCE_1970]):
        begin = min(map(_begin, group.values()))
        for vehicle, flight in group.items():
            time = flight.time + (flight.clock_start - begin)
            changes[flight.log] = dataclasses.replace(flight, log=log, vehicle=vehicle, time=time)
        issues.append(_issue_of(group, "by their stamps"))
    for log, group in _of_one_name([f for f in single if f.log not in changes]):
        if all(f.clock_start is not None and _begin(f) < FLIGHT_BEGINS for f in group.values()):
            for vehicle, flight in group.items():
                changes[flight.log] = dataclasses.replace(flight, log=log, vehicle=vehicle)
            issues.append(_issue_of(group, "by their names and the time since its start"))
        else:
            words = (
                "seem to be vehicles of one flight, each on a clock of its own: put them into one "
                "file with a column `vehicle` and one time; until then wakes can't be judged"
            )
            issues.append(Issue(_names(group), words, kind="vehicles"))
    together = tuple(
        ([changes.get(f.log, f) for f in flights], findings) for flights, findings in logs
    )
    return together, issues


def _begin(flight: Flight) -> float:
    """s that the log's clock reads at the first row; -1 where it is the vehicle's own."""
    return -1.0 if flight.clock_start is None else flight.clock_start + float(flight.time[0])


def _stem(log: str) -> str:
    """A log's name without what it ends in."""
    return Path(log.removesuffix(".gz")).stem


def _vehicle(flight: Flight) -> str:
    """The id of a flight's vehicle by its log or its log's name; empty where none is told."""
    match = ID.search(_stem(flight.log))
    return flight.vehicle if flight.vehicle != "0" else match[1] if match else ""


def _of_one_name(flights: list[Flight]) -> list[tuple[str, dict[str, Flight]]]:
    """(common name, {vehicle: flight}) of flights whose names differ by an id alone."""
    groups: dict[str, dict[str, Flight]] = defaultdict(dict)
    for flight in flights:
        if match := ID.search(_stem(flight.log)):
            stem = _stem(flight.log)
            rest = (stem[: match.start()] + stem[match.end() :]).strip("_-. ")
            groups[rest].setdefault(_vehicle(flight), flight)
    return [(rest or "flight", group) for rest, group in groups.items() if len(group) > 1]


def _of_one_time(flights: list[Flight]) -> list[tuple[str, dict[str, Flight]]]:
    """(name of the first, {vehicle: flight}) of flights at one time whose vehicles are told;
    two logs of one vehicle aren't.
    """
    groups: list[dict[str, Flight]] = []
    for flight in sorted(flights, key=_begin):
        vehicle = _vehicle(flight)
        if not vehicle:
            continue
        if groups and vehicle not in groups[-1] and _overlap(flight, *groups[-1].values()):
            groups[-1][vehicle] = flight
        else:
            groups.append({vehicle: flight})
    return [(_stem(next(iter(g.values())).log), g) for g in groups if len(g) > 1]


def _overlap(flight: Flight, *others: Flight) -> bool:
    """True if a flight and each of the others fly together."""
    overlaps = (
        min(_begin(a) + a.duration, _begin(b) + b.duration)
        - max(_begin(a), _begin(b))
        - OVERLAP * min(a.duration, b.duration)
        for a, b in itertools.product([flight], others)
    )
    return all(overlap > 0.0 for overlap in overlaps)


def _names(group: dict[str, Flight]) -> str:
    return ", ".join(flight.log for flight in group.values())


def _issue_of(group: dict[str, Flight], reason: str) -> Issue:
    words = f"one flight of {' and '.join(group)}, {reason}"
    return Issue(_names(group), words, kind="vehicles")
