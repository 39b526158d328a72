"""Watch policies in three dimensions: `openjax view --policy flight open --scenario
wall`, in a browser or as a file.
"""

import dataclasses
import itertools
import webbrowser
from collections.abc import Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Annotated

from openjax.command_line import output_console, parse
from openjax.commands.evaluate import EvaluateCommand, FlightOptions, fly_scenarios
from openjax.errors import UserError
from openjax.files import check_output
from openjax.ranges import Interval
from openjax.show.replay import replay_page, write_replay
from openjax.show.trajectory import Trajectory

PROGRAM = "openjax view"
OWN_NAMES = ("localhost", "127.0.0.1")
"""Hosts that a browser may have asked for: a page elsewhere can't make its own name
stand for this machine.
"""


@dataclasses.dataclass(frozen=True)
class ViewCommand(FlightOptions):
    """Fly one episode of each layout with each policy, and show them in a browser: the
    page has all in it.
    """

    html: Path | None = None
    """Write the page to this file, to send to somebody, instead of serving it."""
    gif: Path | None = None
    """Write an animation to this file instead, of the first layout with the first policy."""
    mcap: Path | None = None
    """Write an MCAP file for Foxglove instead (pip install mcap)."""
    flights: Path | None = None
    """A folder of flight logs to write with --mcap, in place of flying policies."""
    port: Annotated[int, Interval("[0, 65535]")] = 8080
    """Port of the page, on this machine only."""
    browser: bool = True
    """Open a browser with the page."""


def main(arguments: Sequence[str]) -> int:
    """The command; returns its exit status. Raises UserError for an unusable policy,
    layout, file or port.
    """
    command = parse(ViewCommand, ViewCommand(), arguments, PROGRAM)
    check_output(command.html, "--html")
    check_output(command.gif, "--gif")
    check_output(command.mcap, "--mcap")
    console = output_console()
    if command.flights is not None:
        write_flights(command)
        console.print(_written_line(command.mcap))
        return 0
    flights = fly_all(command)
    if command.mcap is not None:
        from openjax.show.foxglove import trajectory_channels, write_mcap

        channels = []
        for policy, flight in flights:
            channels += trajectory_channels(f"{Path(policy).name}/{flight.title}", flight)
        write_mcap(command.mcap, channels)
        console.print(_written_line(command.mcap))
    if command.gif is not None:
        from openjax.show.videos import animate

        animate(command.gif, [flights[0][1]])
        console.print(f"{command.gif}: {command.gif.stat().st_size / 1e3:,.0f} kB")
    if command.html is not None:
        write_replay(command.html, flights)
        console.print(
            f"{command.html}: {command.html.stat().st_size / 1e3:,.0f} kB, opens in any browser"
        )
    if command.gif is None and command.html is None and command.mcap is None:
        with page_server(replay_page(flights), command.port) as server:
            tell_address(server, command.browser)
            server.serve_forever()
    return 0


def tell_address(server: ThreadingHTTPServer, browser: bool) -> None:
    """Print where the page is, and open it in a browser where that is wanted."""
    address = f"http://localhost:{server.server_port}"
    print(f"{address} (Ctrl-C ends)", flush=True)
    if browser:
        webbrowser.open(address)


def _written_line(path: Path) -> str:
    return f"{path}: {path.stat().st_size / 1e3:,.0f} kB, opens in Foxglove"


def write_flights(command: ViewCommand) -> None:
    """Write the flights of a case as MCAP. Raises UserError for an unusable case, or
    without a file to write to.
    """
    from openjax.flights.case import load_case
    from openjax.flights.flight_channels import flight_channels
    from openjax.show.foxglove import write_mcap

    if command.mcap is None:
        raise UserError("--flights writes logs for Foxglove: name the file by --mcap FILE")
    nameless = not (command.flights / "vehicle.toml").exists()
    # to look at, any vehicle will do
    case = load_case(command.flights, comparison=nameless)
    # one flight's channels at a time: a log of an hour holds millions of rows
    channels = (flight_channels(flight) for flight in case.flights)
    write_mcap(command.mcap, itertools.chain.from_iterable(channels))


def fly_all(command: ViewCommand) -> list[tuple[str, Trajectory]]:
    """(policy, episode) pairs, policies in the order of the command.

    Raises:
      UserError: an unusable policy or layout.
    """
    flights = []
    evaluators = {}
    options = {
        field.name: getattr(command, field.name) for field in dataclasses.fields(FlightOptions)
    }
    for policy in command.start():
        # each policy flies the game that it was trained in
        evaluation = EvaluateCommand(**options, episodes=1, environment=policy.settings.environment)
        for kind in fly_scenarios(evaluation, policy, evaluators):
            flights.append((policy.source, kind.trajectory(0, kind.name)))
    return flights


def page_server(page: str, port: int) -> ThreadingHTTPServer:
    """A server of one page, to be used as a context manager, that this machine's
    browsers alone can reach.

    Raises:
      UserError: the port isn't free.
    """
    content = page.encode()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            host = self.headers.get("Host", "").rpartition(":")[0] or self.headers.get("Host", "")
            is_page = self.path == "/" and host in OWN_NAMES
            self.send_response(200 if is_page else 404)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(content) if is_page else 0))
            self.end_headers()
            if is_page:
                self.wfile.write(content)

        def log_message(self, *_):
            """Say nothing."""

    return local_server(Handler, port)


def local_server(handler: type[BaseHTTPRequestHandler], port: int) -> ThreadingHTTPServer:
    """A server that this machine alone can reach.

    Raises:
      UserError: the port isn't free.
    """
    try:
        return ThreadingHTTPServer(("127.0.0.1", port), handler)
    except OSError as error:
        raise UserError(f"--port {port}: {error.strerror or error}") from None
