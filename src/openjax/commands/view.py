"""Watch a policy in three dimensions in a browser: `openjax view --scenario wall`.

Needs `pip install viser`.
"""

import dataclasses
import importlib.util
from collections.abc import Sequence
from typing import Annotated

from openjax.commands.command_line import parse
from openjax.commands.evaluate import EvaluateCommand, fly_scenarios
from openjax.errors import UserError
from openjax.ranges import Interval, Seed
from openjax.store import DEFAULT_POLICY

PROGRAM = "openjax view"


@dataclasses.dataclass(frozen=True)
class ViewCommand:
    """Fly one episode of each layout and show them in a browser."""

    policy: str = DEFAULT_POLICY
    """A run's directory, a policy file (.npz), a checkpoint, or the name of a policy in the package."""
    scenario: str = "all"
    """wall, narrow_gap, random, passage, empty, hidden, a TOML file with an own layout, or all six."""
    seed: Seed = 0
    """Draws the start attitudes."""
    port: Annotated[int, Interval("[0, 65535]")] = 8080
    """Where the page is served, on this machine only."""


def main(arguments: Sequence[str]) -> int:
    """The command; returns its exit status. Raises UserError without viser, or for an unusable policy or layout."""
    command = parse(ViewCommand, ViewCommand(), arguments, PROGRAM)
    if importlib.util.find_spec("viser") is None:
        raise UserError("the viewer needs viser: pip install viser")
    viewer = open_viewer(command)
    print(f"http://localhost:{viewer.server.get_port()} (Ctrl-C ends)", flush=True)
    viewer.play()
    return 0


def open_viewer(command: ViewCommand):
    """Fly the episodes and serve the page; returns the `openjax.show.viewer.Viewer`.

    Raises:
      UserError: an unusable policy, layout or port.
    """
    from openjax.store.policies import load_policy

    loaded = load_policy(command.policy)
    flown = EvaluateCommand(
        policy=(command.policy,),
        scenario=command.scenario,
        episodes=1,
        seed=command.seed,
        environment=loaded.settings.environment,
    )
    _, flights = fly_scenarios(flown, loaded, {})
    import viser

    from openjax.show.viewer import Viewer

    try:
        server = viser.ViserServer(host="127.0.0.1", port=command.port, label="openjax", verbose=False)
    except OSError as error:
        raise UserError(f"--port {command.port}: {error.strerror or error}") from None
    return Viewer(server, flights)
