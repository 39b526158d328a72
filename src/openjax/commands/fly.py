"""`openjax fly --policy PATH --uri URI [URI ...]`: fly a policy on Crazyflies, real or virtual.

A hundred times a second from poses to body rates and thrust, through the real `cflib`. The flight
is written as a case that `openjax diagnose` reads.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, NamedTuple

from openjax.command_line import output_console, parse
from openjax.errors import UserError
from openjax.files import check_new_folder, check_room
from openjax.flying.endpoints import UDP_PORT, endpoints_of, sole_command
from openjax.flying.state import SafetySettings
from openjax.ranges import Interval
from openjax.store import default_policy

PROGRAM = "openjax fly"
DRIFT = 0.1
"""m/s, of an own estimate, that nothing on board tells (experiments/results/flying.md)."""


@dataclass(frozen=True)
class FlyCommand:
    """Fly a policy on as many Crazyflies as it has pursuers, and log it for the diagnosis.

    While it flies: space or q stops all motors; l, Ctrl-C, Ctrl-Z or a closed terminal land; h
    waits.
    """

    policy: str | None = None
    """A run's directory, a policy file (.npz), or the name of a policy in the package;
    by default evaders, or teams for a layout of another number of pursuers than three.
    """
    plan: str | None = None
    """Fly a plan instead, with one vehicle: identify (two minutes by which a vehicle
    shows what it does), or a CSV of openjax plan.
    """
    uri: tuple[str, ...] = tuple(f"udp://127.0.0.1:{UDP_PORT + i}" for i in range(3))
    """One vehicle per pursuer: udp://HOST:PORT (virtual), radio://0/80/2M/E7E7E7E7E7 (real)."""
    evader_uri: str | None = None
    """A further vehicle that flies the evader by the game's rule; without it the evader
    is a point in the computer.
    """
    scenario: str = "wall"
    """Layout: a name or a TOML file. Pillars exist in the computer only, unless you put them up."""
    episodes: Annotated[int, Interval("[1, 100000]")] = 1
    """Games, one after the other. Between them all fly straight back: with real pillars
    leave it at 1.
    """
    episode_seconds: Annotated[float | None, Interval("(0, 1e9]")] = None
    """End each game after this time; otherwise it lasts as long as in training."""
    out: Path | None = None
    """Folder for the logs, a case for openjax.diagnose; must not exist or be empty."""
    vehicle: Path | None = None
    """The vehicle that flies (crazyflie, brushless, or a vehicle.toml); by default the airframe
    that the policy was trained for.
    """
    body_logs: Annotated[int | None, Interval("[0, 5]")] = None
    """Log blocks of motors and accelerometer per vehicle, 0 to 5; default 5 over UDP, 1
    over radio.
    """
    motion_capture: str | None = None
    """MODULE:FUNCTION that feeds poses; default: the vehicles' own estimates. See
    openjax.flying.motion_capture.
    """
    guard: bool = True
    """A further process lands the vehicles if the others stop. Don't fly real ones without."""
    guard_after: Annotated[float, Interval("[0.01, 60]")] = 0.1
    """Silence of the loop, or of the links, after which the next process lands all (s)."""
    watchdog: bool = True
    """Let the firmware stop the motors 1 s after the last set-point (otherwise 2 s). It
    locks the vehicle, also after the flight; the next one restarts it.
    """
    safety: SafetySettings = field(default_factory=SafetySettings)


def main(arguments: Sequence[str]) -> None:
    """The command. Raises UserError where nothing was flown."""
    fly(parse(FlyCommand, FlyCommand(), arguments, PROGRAM))


def fly(arguments: FlyCommand, preparation: Prepared | None = None) -> None:
    """Fly. Raises UserError for what can't be, and where another process had to land the vehicles.

    Args:
      arguments: the command's.
      preparation: what `prepare` made of them, where that was done before.
    """
    arguments = check(arguments)
    with sole_command(uris_of(arguments)):  # before minutes of compiling
        _fly(arguments, preparation)


def _fly(arguments: FlyCommand, preparation: Prepared | None) -> None:
    """Fly vehicles that are nobody else's."""
    console = output_console()
    from openjax.flying.course import FlightPlan
    from openjax.flying.loop import FlightLoop
    from openjax.flying.session import Session

    if preparation is None:
        what = "the policy" if arguments.plan is None else "the plan"
        console.print(f"loading {what}, compiling the tick ...")
    setup = preparation or prepare(arguments)
    for line in setup.remarks:
        console.print(line, soft_wrap=True)
    console.print(f"connecting to {', '.join(setup.session.uris)} ...")
    with Session(setup.session, setup.state, _case(arguments, setup)) as session:
        session.check()
        plan = FlightPlan(arguments.episodes, arguments.episode_seconds or math.inf)
        flight = FlightLoop(
            session.links,
            setup.game,
            setup.state,
            plan,
            session.requests,
            session.watch,
            session.record,
        )
        console.print("flying: space or q stops all motors; l, Ctrl-C or Ctrl-Z land; h waits")
        outcome = session.fly(flight)
    _show(console, flight, arguments.plan is not None)
    if session.scheduler != "real time":
        console.print("no real-time scheduling: a busy machine misses deadlines (docs/flying.md)")
    if outcome.folder is not None:
        console.print(f"{outcome.folder}: {_next(outcome)}", soft_wrap=True)
    if outcome.complaint:
        raise UserError(outcome.complaint)


def _next(outcome) -> str:
    """The use of a flight's log, in words."""
    from openjax.flights.airborne import SHORTEST

    if outcome.longest >= SHORTEST:
        return f"next: openjax diagnose {outcome.folder}"
    if outcome.longest:
        return f"the longest game took {outcome.longest:.1f} s; a diagnosis needs {SHORTEST:g} s"
    return "no game was flown; flight.json says why the flight ended"


class Prepared(NamedTuple):
    """A prepared flight."""

    game: object
    state: object  # of the safety, before the flight
    session: object  # its settings
    vehicle: object
    about: dict
    remarks: tuple[str, ...] = ()
    seconds: float = math.inf  # that it may take in the air


class Assignment(NamedTuple):
    """A policy's game or a plan that will be flown, before its vehicle is known."""

    game: Callable  # airframe -> the game, compiled
    airframe: str | None  # the usual one's name; None: a plan is for any
    about: dict  # for flight.json
    seconds: float  # that it may take in the air
    remarks: tuple[str, ...] = ()


def prepare(arguments: FlyCommand) -> Prepared:
    """Policy, layout and vehicle, compiled; vehicles aren't needed for it."""
    from openjax.flying import real_time
    from openjax.flying.controller import airframe_of
    from openjax.flying.loop import flight_state
    from openjax.vehicle.vehicle_file import load_vehicle_file

    real_time.prepare()
    assignment = _game(arguments) if arguments.plan is None else _plan(arguments)
    vehicle = load_vehicle_file(arguments.vehicle or assignment.airframe)
    session = _session(arguments)  # before the game, which takes its time to compile
    game = assignment.game(airframe_of(vehicle.vehicle))
    state = flight_state(game, len(session.uris), arguments.safety)
    remarks = assignment.remarks
    if assignment.airframe not in (None, vehicle.airframe):
        other = f"the policy was trained for {assignment.airframe}, but {vehicle.airframe} flies"
        remarks = (*remarks, other)
    remarks = (*remarks, *_time_remark(arguments, assignment.seconds))
    about = assignment.about | {"uris": session.uris}
    return Prepared(game, state, session, vehicle, about, remarks, assignment.seconds)


def _game(arguments: FlyCommand) -> Assignment:
    """A policy's game in a layout."""
    from openjax.flying.game import Game
    from openjax.pursuit import PursuitSettings, find_scenario, scenario_task
    from openjax.store.policies import load_policy

    name = arguments.policy
    line = ""
    if name is None:
        number = len(find_scenario(arguments.scenario, PursuitSettings()).pursuers)
        name, line = default_policy(PursuitSettings(num_pursuers=number))
    policy = load_policy(name)
    scenario = find_scenario(arguments.scenario, policy.settings.environment)
    policy = policy.of_team(len(scenario.pursuers))
    settings = policy.settings.environment
    _check_numbers(arguments, len(scenario.pursuers), settings.num_pursuers)
    # a layout may have more pillars than the policy was trained with; it observes the nearest ones
    slots = max(settings.max_pillars, len(scenario.pillars))
    task = scenario_task(dataclasses.replace(settings, max_pillars=slots), scenario)
    length = settings.episode_length * settings.time_step
    seconds = arguments.episodes * min(length, arguments.episode_seconds or math.inf)
    about = {"policy": policy.source, "scenario": scenario.name}
    if settings.strategies > 1:
        period = round(settings.strategy_steps * settings.time_step, 6)
        about |= {"strategies": settings.strategies, "strategy_seconds": period}
    remarks = (line,) if line else ()
    return Assignment(
        functools.partial(Game, policy, task), settings.airframe, about, seconds, remarks
    )


def _plan(arguments: FlyCommand) -> Assignment:
    """A plan in a policy's place."""
    from openjax.flights.manoeuvres import PERIOD
    from openjax.flights.plans import read_plan
    from openjax.flying.planned import PlannedFlight

    plan = read_plan(arguments.plan)
    source = f"plan {arguments.plan}"
    about = {"policy": source, "scenario": source}
    return Assignment(functools.partial(PlannedFlight, plan), None, about, len(plan) * PERIOD)


def _session(arguments: FlyCommand):
    """The session's settings."""
    from openjax.flying.motion_capture import find_feed
    from openjax.flying.session import SessionSettings

    uris = uris_of(arguments)
    body_logs = arguments.body_logs
    if body_logs is None:
        # a radio has less room, which commands and poses need first
        body_logs = 5 if all(uri.startswith("udp:") for uri in uris) else 1
    feed = find_feed(arguments.motion_capture) if arguments.motion_capture else None
    return SessionSettings(
        uris, body_logs, arguments.watchdog, arguments.guard, arguments.guard_after, feed
    )


def _time_remark(arguments: FlyCommand, seconds: float) -> tuple[str, ...]:
    """A remark on what goes unnoticed in a flight of so many seconds by own estimates alone, and on
    whether it will be cut short.
    """
    if arguments.motion_capture is not None:
        return ()
    limit = arguments.safety.alone_time
    away = DRIFT * min(limit, seconds)
    remarks = (
        f"without --motion_capture a slow drift of an estimate isn't noticed: one of {DRIFT:g} m/s "
        f"leads {away:.1f} m away in this flight (docs/flying.md)",
    )
    if seconds < limit:
        return remarks
    return (
        *remarks,
        f"all land after {limit:g} s in the air (--safety.alone_time); this flight takes "
        f"{seconds:.0f} s",
    )


def _case(arguments: FlyCommand, setup: Prepared):
    """The case to be written, if one is to be; a flight for which there is no room
    raises UserError.
    """
    from openjax.flying.flight_files import bytes_needed
    from openjax.flying.recorder import NewCase
    from openjax.vehicle.vehicle_file import save_vehicle_file

    if arguments.out is None:
        return None
    alone = math.inf if arguments.motion_capture else arguments.safety.alone_time
    needed = bytes_needed(len(setup.state.drones), min(setup.seconds, alone))
    check_room(arguments.out, needed, "--out")
    policy = setup.about["policy"]
    vehicle_file = dataclasses.replace(
        setup.vehicle,
        path=None,
        log={"source": f"openjax.fly, policy {policy}", "floor_z": 0.0},
    )
    with tempfile.TemporaryDirectory() as folder:
        save_vehicle_file(Path(folder) / "vehicle.toml", vehicle_file)
        files = {path.name: path.read_bytes() for path in Path(folder).iterdir()}
    return NewCase(arguments.out, files, setup.about)


def _check_numbers(arguments, starts, pursuers):
    """Raises UserError where vehicles, starts and pursuers aren't equally many."""
    vehicles = len(arguments.uri)
    if vehicles != pursuers:
        plural = "s" * (vehicles > 1)
        raise UserError(
            f"--uri names {vehicles} vehicle{plural}, the policy flies {pursuers}: name all after "
            "one --uri"
        )
    if starts != pursuers:
        raise UserError(
            f"--scenario {arguments.scenario} has {starts} starts, the policy flies {pursuers}"
        )


def uris_of(arguments: FlyCommand) -> tuple[str, ...]:
    """The vehicles: pursuers, then the evader where it is one."""
    evader = () if arguments.evader_uri is None else (arguments.evader_uri,)
    return (*arguments.uri, *evader)


def check(arguments: FlyCommand) -> FlyCommand:
    """The arguments, their URIs as `cflib` wants them. Raises UserError."""
    if arguments.plan is not None:
        if arguments.uri == FlyCommand.uri:  # as many as a policy has pursuers
            arguments = dataclasses.replace(arguments, uri=FlyCommand.uri[:1])
        if len(uris_of(arguments)) != 1:
            raise UserError(
                f"--plan flies one vehicle, --uri names {len(uris_of(arguments))}: name one"
            )
    uris = [endpoint.uri for endpoint in endpoints_of(uris_of(arguments))]
    number = len(arguments.uri)
    evader = None if arguments.evader_uri is None else uris[-1]
    if arguments.out is not None:
        check_new_folder(arguments.out, "--out")
    return dataclasses.replace(arguments, uri=tuple(uris[:number]), evader_uri=evader)


def _show(console, flight, is_plan):
    record = flight.record
    timing = record.timing()
    if not timing["ticks"]:
        return
    age = timing["command_age_ms"]
    console.print(
        f"{timing['seconds']:.1f} s, {timing['ticks']} ticks: command age {age['p50']:.2f} ms "
        f"median, {age['p99']:.2f} ms p99; {timing['missed_deadlines']} missed deadlines "
        f"({timing['missed_share']:.2%})"
    )
    for number, game in enumerate(() if is_plan else record.games):
        outcome = f"caught at step {game.capture_step}" if game.capture_step else "not caught"
        console.print(
            f"game {number}: {outcome}, {game.steps} steps, {game.breaches} with a breach"
        )
    for i, drone in enumerate(flight.state.drones):
        if drone.reason not in ("", "asked to land"):
            console.print(f"vehicle {i}: {drone.mode.value}, {drone.reason}")
