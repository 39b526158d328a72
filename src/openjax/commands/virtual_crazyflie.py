"""`openjax virtual_crazyflie`: Crazyflies that are simulated, for everything that
speaks to real ones.

They answer CRTP over UDP as `cflib` expects (`udp://127.0.0.1:19850` and on); inside
fly openjax's vehicles in real time, rate loop at 500 Hz, with any effects, and a link
with latency and loss to order.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from openjax.command_line import output_console, parse
from openjax.flying.endpoints import UDP_PORT
from openjax.interruption import as_exception
from openjax.ranges import Interval
from openjax.virtual_crazyflie.link import LinkFaults

PROGRAM = "openjax virtual_crazyflie"
MIDDLE = "middle"
"""In a layout's place: the first stands in the middle, where plans begin."""


@dataclass(frozen=True)
class VirtualCrazyflieCommand:
    """Fly virtual Crazyflies until interrupted; each has a port of its own."""

    number: Annotated[int, Interval("[1, 10]")] = 3
    """Vehicles that fly."""
    host: str = "127.0.0.1"
    """Address to listen at."""
    port: Annotated[int, Interval("[0, 65535]")] = UDP_PORT
    """UDP port of the first; cflib's scan looks at 19850 to 19859."""
    scenario: str = "wall"
    """They stand below the pursuers' starts of this layout (a name or a TOML file); more of them in
    a row behind. middle: the first in the middle, where the plans of openjax fly --plan begin.
    """
    vehicle: Path | None = None
    """The vehicle inside: crazyflie, brushless, or a vehicle.toml; by default the Crazyflie 2.1."""
    effects: Path | None = None
    """Physical effects that it suffers from (effects.toml)."""
    battery: Annotated[float, Interval("(0, 1]")] = 1.0
    """Charge at the start, 0 to 1."""
    endurance: Annotated[float, Interval("(0, 100000]")] = 420.0
    """Seconds of hover that a full battery lasts."""
    needs_arming: bool = True
    """Motors stay off until armed; False: armed from the start, as brushed Crazyflies are."""
    seconds: Annotated[float | None, Interval("(0, 1e9]")] = None
    """End after this time; by default only when interrupted."""
    link: Annotated[LinkFaults, tyro.conf.arg(name="")] = field(default_factory=LinkFaults)


def make(arguments: VirtualCrazyflieCommand):
    """The virtual Crazyflies, listening. Raises UserError for what can't be."""
    from openjax.pursuit import PursuitSettings, find_scenario
    from openjax.vehicle.effects import load_effects
    from openjax.vehicle.vehicle_file import load_vehicle_file
    from openjax.virtual_crazyflie.process import VirtualCrazyflies
    from openjax.virtual_crazyflie.vehicles import VirtualVehicles

    starts = ((0.0, 0.0, 0.0),)
    if arguments.scenario != MIDDLE:
        starts = find_scenario(arguments.scenario, PursuitSettings()).pursuers
    stands = [start[:2] for start in starts][: arguments.number]
    # more than a layout has stand outside the arena, apart
    stands += [(0.2 * i, -1.4) for i in range(arguments.number - len(stands))]
    effects = load_effects(arguments.effects)[1] if arguments.effects else {}
    vehicle = load_vehicle_file(arguments.vehicle).vehicle
    vehicles = VirtualVehicles(vehicle, stands, effects, arguments.battery, arguments.endurance)
    return VirtualCrazyflies(
        vehicles, arguments.host, arguments.port, arguments.link, arguments.needs_arming
    )


def main(arguments: Sequence[str]) -> None:
    """The command; it runs until it is stopped."""
    options = parse(VirtualCrazyflieCommand, VirtualCrazyflieCommand(), arguments, PROGRAM)
    from openjax.flying import real_time

    real_time.prepare()
    virtual = make(options)
    console = output_console()
    try:
        real_time.hurry()
        console.print(f"listening: --uri {' '.join(virtual.uris)}")
        with as_exception():
            virtual.run(lambda: virtual.time >= (options.seconds or math.inf))
    except KeyboardInterrupt:
        pass
    finally:
        virtual.close()
    console.print(f"{virtual.time:.0f} s; {virtual.late} steps late by more than 20 ms")
