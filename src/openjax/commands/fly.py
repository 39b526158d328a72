"""`openjax fly --policy PATH --uri URI [URI ...]`: fly a policy on Crazyflies, real or virtual.

A hundred times a second from poses to body rates and thrust, through the real `cflib`. The flight is written as a case
that `openjax diagnose` reads.
"""

from __future__ import annotations

import dataclasses
import math
import select
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from openjax.commands.command_line import output_console, parse
from openjax.errors import UserError
from openjax.files import check_new_folder, replacing
from openjax.flying.limits import SafetySettings
from openjax.flying.safety import Request
from openjax.ranges import Interval
from openjax.store import DEFAULT_POLICY

PROGRAM = "openjax fly"
FRESH = 0.05
"""No flight begins with poses older than this (s)."""
KEYS = {" ": Request.STOP, "q": Request.STOP, "l": Request.LAND, "h": Request.HOLD}


@dataclass(frozen=True)
class Arguments:
    """Fly a policy on as many Crazyflies as it has pursuers, and log it for the diagnosis.

    While it flies: space or q stops all motors, l lands, h waits; Ctrl-C lands.
    """

    policy: str = DEFAULT_POLICY
    """A run's directory, a policy file (.npz), or the name of a policy in the package."""
    uri: tuple[str, ...] = ("udp://127.0.0.1:19850", "udp://127.0.0.1:19851", "udp://127.0.0.1:19852")
    """One vehicle per pursuer: udp://HOST:PORT (virtual), radio://0/80/2M/E7E7E7E7E7 (real)."""
    evader_uri: str | None = None
    """A further vehicle that flies the evader by the game's rule; without it the evader is a point in the computer."""
    scenario: str = "wall"
    """Layout: a name or a TOML file. Pillars exist in the computer only, unless you put them up."""
    episodes: Annotated[int, Interval("[1, 100000]")] = 1
    """Games, one after the other. Between them all fly straight back: with real pillars leave it at 1."""
    episode_seconds: Annotated[float | None, Interval("(0, 1e9]")] = None
    """End each game after this time; otherwise it lasts as long as in training."""
    out: Path | None = None
    """Folder for the logs, a case for openjax.diagnose; must not exist or be empty."""
    vehicle: Path | None = None
    """What flies (crazyflie, brushless, or a vehicle.toml), for the hover thrust and the case."""
    body_logs: Annotated[int | None, Interval("[0, 5]")] = None
    """Log blocks of motors and accelerometer per vehicle, 0 to 5; default 5 over UDP, 1 over radio."""
    motion_capture: str | None = None
    """MODULE:FUNCTION that feeds poses; default: the vehicles' own estimates. See openjax.flying.motion_capture."""
    guard: bool = True
    """A second process lands the vehicles if this one stops."""
    guard_after: Annotated[float, Interval("[0.01, 60]")] = 0.1
    """Silence of this one after which it does (s)."""
    watchdog: bool = False
    """Let the firmware stop the motors 1 s after the last set-point (otherwise 2 s); the vehicles must be restarted after
    every flight."""
    safety: SafetySettings = field(default_factory=SafetySettings)


def main(arguments: Sequence[str]) -> int:
    """The command; its exit status is 2 where nothing was flown."""
    parsed = parse(Arguments, Arguments(), arguments, PROGRAM)
    flight = fly(parsed)
    return 0 if flight is not None else 2


def fly(arguments: Arguments):
    """Fly; returns the record. Raises UserError for what can't be."""
    _check(arguments)
    console = output_console()
    console.print("loading the policy, compiling the tick ...")
    from openjax.flying import real_time
    from openjax.flying.flight_files import write_case
    from openjax.flying.game import Game
    from openjax.flying.guard import Guard
    from openjax.flying.links import Links
    from openjax.flying.loop import Flight, Plan
    from openjax.flying.motion_capture import MotionCaptured, find_feed
    from openjax.pursuit import find_scenario, scenario_task
    from openjax.store.policies import load_policy
    from openjax.vehicle.vehicle_file import load_vehicle_file

    real_time.prepare()
    policy = load_policy(arguments.policy)
    settings = policy.settings.environment
    if len(arguments.uri) != settings.num_pursuers:
        raise UserError(
            f"--uri names {len(arguments.uri)} vehicles, the policy flies {settings.num_pursuers}"
        )
    scenario = find_scenario(arguments.scenario, settings)
    if len(scenario.pursuers) != settings.num_pursuers:
        raise UserError(
            f"--scenario {scenario.name} has {len(scenario.pursuers)} pursuers, the policy {settings.num_pursuers}"
        )
    slots = max(settings.max_pillars, len(scenario.pillars))
    vehicle = load_vehicle_file(arguments.vehicle)
    feed = find_feed(arguments.motion_capture) if arguments.motion_capture else None
    game = Game(policy, scenario_task(dataclasses.replace(settings, max_pillars=slots), scenario))
    game.hover_thrust = _hover_thrust(vehicle.vehicle)
    uris = [*arguments.uri, *([arguments.evader_uri] if arguments.evader_uri else [])]
    body_logs = arguments.body_logs
    if body_logs is None:
        body_logs = 5 if all(uri.startswith("udp:") for uri in uris) else 1
    vehicles = links = Links(uris, body_logs, arguments.watchdog)
    console.print(f"connecting to {', '.join(uris)} ...")
    links.connect()
    plan = Plan(arguments.episodes, arguments.episode_seconds or math.inf)
    guard = flight = None
    with _Keys() as keys:
        try:
            if feed is not None:
                vehicles = MotionCaptured(links)
                vehicles.feed(feed)
            _wait_for_poses(vehicles, uris)
            flight = Flight(vehicles, game, arguments.safety, plan, keys)
            if arguments.guard:
                guard = flight.beat = Guard(
                    uris,
                    links.pose_blocks(),
                    arguments.safety,
                    flight.state,
                    arguments.guard_after,
                    links.pid,
                )
                if not guard.wait():
                    raise UserError("the guard's process didn't start; --guard False flies without it")
            _wait_for_poses(vehicles, uris)  # nobody looked meanwhile
            links.arm()
            vehicles.record()
            scheduler = real_time.hurry()
            if scheduler != "real time":
                console.print(
                    "no real-time scheduler: on a busy machine deadlines will be missed (docs/flying.md)"
                )
            console.print("flying: space or q stops all motors, l or Ctrl-C lands")
            record = _until_down(flight, keys)
            samples = vehicles.samples()
        except KeyboardInterrupt:
            links.emergency_stop()
            raise
        except Exception as error:
            if guard is not None and flight.state.flying:
                console.print(f"error: {error}: the guard lands the vehicles", soft_wrap=True)
                guard.hand_over()
            raise
        finally:
            if guard is not None:
                guard.close()
            links.close()
    about = {
        "policy": policy.source,
        "scenario": scenario.name,
        "uris": uris,
        "scheduler": scheduler,
        "reasons": [d.reason for d in flight.state.drones],
    }
    _show(console, record, flight)
    if arguments.out is not None:
        described = dataclasses.replace(
            vehicle, path=None, log={"source": f"openjax.fly, policy {policy.source}", "floor_z": 0.0}
        )
        with replacing(arguments.out) as folder:
            folder.mkdir()
            write_case(folder, samples, record, described, about)
        console.print(f"{arguments.out}: next, openjax diagnose {arguments.out}")
    return record


def _check(arguments):
    if len(set(arguments.uri)) < len(arguments.uri):
        raise UserError("--uri names a vehicle twice")
    if arguments.out is not None:
        check_new_folder(arguments.out, "--out")


def _hover_thrust(vehicle) -> float:
    most = 4 * vehicle.thrust_constant * vehicle.max_rotor_speed**2
    return float(vehicle.mass * vehicle.gravity / most)


def _wait_for_poses(vehicles, uris, timeout=5.0):
    deadline = time.monotonic() + timeout
    while True:
        now = time.perf_counter()
        old = [s.pose is None or now - s.pose.time > FRESH for s in vehicles.sightings()]
        if not any(old):
            return
        if time.monotonic() > deadline:
            silent = ", ".join(uri for uri, missing in zip(uris, old, strict=True) if missing)
            raise UserError(f"no pose from {silent} within {timeout:g} s; is its position known?")
        vehicles.wait(now + 0.02)


def _until_down(flight, keys):
    """The flight's record; the first Ctrl-C lands, a second one stops."""
    try:
        return flight.run()
    except KeyboardInterrupt:
        keys.pressed = Request.LAND
        return flight.run()


def _show(console, record, flight):
    timing = record.timing()
    age = timing["command_age_ms"]
    console.print(
        f"{timing['seconds']:.1f} s, {timing['ticks']} ticks: command age {age['p50']:.2f} ms median, "
        f"{age['p99']:.2f} ms p99; {timing['missed_deadlines']} missed deadlines ({timing['missed_share']:.2%})"
    )
    for number, game in enumerate(record.episodes):
        caught = f"caught at step {game['capture_step']}" if game["capture_step"] else "not caught"
        console.print(f"game {number}: {caught}, {game['steps']} steps, {game['breaches']} with a breach")
    for i, drone in enumerate(flight.state.drones):
        if drone.reason not in ("", "asked to land"):
            console.print(f"vehicle {i}: {drone.mode.value}, {drone.reason}")


class _Keys:
    """Keys of a terminal as requests, without waiting for them."""

    def __init__(self):
        self.pressed, self._restore = Request.NONE, None

    def __enter__(self):
        if sys.stdin.isatty():
            import termios
            import tty

            before = termios.tcgetattr(sys.stdin)
            tty.setcbreak(sys.stdin)
            self._restore = lambda: termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
        return self

    def __exit__(self, *_):
        if self._restore is not None:
            self._restore()

    def __call__(self) -> Request:
        request, self.pressed = self.pressed, Request.NONE
        if self._restore is not None and select.select([sys.stdin], [], [], 0)[0]:
            request = KEYS.get(sys.stdin.read(1), request)
        return request
