"""Be the evader: `openjax play --policy evaders`, in a browser on this machine."""

import dataclasses
import threading
from collections.abc import Sequence
from typing import Annotated

import tyro

from openjax.command_line import output_console, parse
from openjax.commands.evaluate import EvaluateCommand, FlightOptions, find_game
from openjax.commands.view import tell_address
from openjax.errors import UserError
from openjax.ranges import Interval
from openjax.show.replay import LONGEST_STEP

PROGRAM = "openjax play"


@dataclasses.dataclass(frozen=True)
class PlayCommand(FlightOptions):
    """Fly the evader yourself, against a policy that hunts you, in a browser.

    Arrow keys fly, W and S go up and down, or the evader follows the mouse. A game ends
    with your capture or after its time; the page has its replay.
    """

    scenario: str = "uniform"
    """uniform (another task in each game), wall, narrow_gap, random, passage, empty,
    hidden, or a TOML file with an own layout.
    """
    opponent: tyro.conf.Suppress[str | None] = None
    """You."""
    port: Annotated[int, Interval("[0, 65535]")] = 8080
    """Port of the page, on this machine only."""
    browser: bool = True
    """Open a browser with the page."""


def main(arguments: Sequence[str]) -> int:
    """The command; returns its exit status. Raises UserError for an unusable policy,
    layout or port.
    """
    command = parse(PlayCommand, PlayCommand(), arguments, PROGRAM)
    if command.scenario == "all":
        raise UserError("--scenario all: name one layout, or uniform")
    table = make_table(command)
    from openjax.commands.play_server import play_server

    with play_server(table, command.port) as server:
        threading.Thread(target=table.play, args=(threading.Event(),), daemon=True).start()
        tell_address(server, command.browser)
        server.daemon_threads = True  # pages that listen don't keep the program
        server.serve_forever()
    return 0


def make_table(command: PlayCommand):
    """The games of a command, compiled. Raises UserError for an unusable policy or layout."""
    import jax

    from openjax.commands.play_game import Simulation
    from openjax.commands.play_server import PlaySession
    from openjax.pursuit import scenario_task
    from openjax.pursuit.task import uniform_task

    policies = command.start()
    if len(policies) != 1:
        raise UserError(f"--policy names {len(policies)} policies; name the one that hunts you")
    (policy,) = policies
    options = {
        field.name: getattr(command, field.name) for field in dataclasses.fields(FlightOptions)
    }
    # each policy flies the game that it was trained in
    flight = EvaluateCommand(**options, environment=policy.settings.environment)
    environment, policy, layouts = find_game(flight, policy)
    settings = environment.settings

    def draw_task(key):
        return scenario_task(settings, layouts[0]) if layouts else uniform_task(settings, key)

    simulation = Simulation(environment, policy, draw_task)
    output_console().print("compiling the game ...")
    first = jax.random.key(command.seed)
    simulation.begin(first).step((0.0, 0.0, 0.0))  # compiled before anybody waits for it
    every = max(1, round(LONGEST_STEP / settings.time_step))
    return PlaySession(lambda number: simulation.begin(jax.random.fold_in(first, number)), every)
