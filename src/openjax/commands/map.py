"""Show what a policy catches: `openjax map --policy RUN`.

It flies with teams of each size, after evaders of each speed, with each capture radius:
after scripted evaders, after some that learned to escape from this policy, and, in some
cells, after one that plans. The picture shows the share of captures in each cell, and
the line below which a theorem forces one for points without inertia
(`openjax.baselines.stack`); `--page` writes a page to move about in.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from openjax.command_line import output_console, parse
from openjax.commands.options import MapCommand
from openjax.errors import UserError
from openjax.files import check_output, write_json, write_text
from openjax.pursuit.evaders.kinds import check_evaders
from openjax.store.compiled_programs import cache_programs

PROGRAM = "openjax map"
ON_CPU = {
    "speed_ratios": (0.8, 1.3, 2.0),
    "radii": (0.2, 0.3, 0.4),
    "episodes": 4,
    "batch": 96,
    "best_response": False,
}
"""Smaller defaults without an accelerator: enough to see it work."""


def main(arguments: Sequence[str]) -> int:
    """The command; returns its exit status. Raises UserError for a policy or a file
    that can't be used.
    """
    command = parse(MapCommand, MapCommand(), arguments, PROGRAM)
    if command.compilation_cache:
        cache_programs()
    import jax

    from openjax.commands.catch_map import draw_map, map_game
    from openjax.commands.map_page import map_page
    from openjax.store.policies import load_policy

    policy = load_policy(command.policy)
    game_of_training = policy.settings.environment
    less = ON_CPU if jax.default_backend() == "cpu" else {}
    if not command.messages.perfect:
        less = less | {"best_response": False}  # who learns doesn't know what was heard
    sizes = {} if game_of_training.team_sizes else {"sizes": (game_of_training.num_pursuers,)}
    default = dataclasses.replace(MapCommand(), **less, **sizes)
    command = parse(MapCommand, default, arguments, PROGRAM)
    for option in ("out", "json", "page", "evaders_out"):
        check_output(getattr(command, option), f"--{option}")
    if command.out.suffix not in (".png", ".svg", ".pdf"):
        raise UserError(f"--out {command.out}: a picture ends in .png, .svg or .pdf")
    check_evaders(command.evaders)
    map_game(command, game_of_training)
    console = output_console()

    def keep(results):
        if command.json is not None:
            write_json(command.json, results)

    results = draw_map(command, policy, lambda text: console.print(text, soft_wrap=True), keep)
    if command.page is not None:
        write_text(command.page, map_page({command.scenario: results}))
    _show(command, results, console)
    return 0


def _show(command, results, console):
    """Draw the picture, of evaders that learned where there are some, and tell the least cell."""
    from openjax.commands.catch_map import cells_against
    from openjax.show.plots import plot_map

    who = "learned" if command.best_response else "scripted"
    cells = cells_against(results, who)
    plot_map(
        command.out,
        cells,
        f"{Path(command.policy).name}: captures, {command.scenario}, {who} evaders",
    )
    least = min(cells, key=lambda cell: cell["capture_rate"])
    console.print(
        f"{command.out}: {len(cells)} cells of {command.episodes} episodes; the lowest rate is "
        f"{least['capture_rate']:.2f}, with {least['num_pursuers']} pursuers, "
        f"{least['speed_ratio']:g} times their speed and {least['capture_radius']:g} m",
        soft_wrap=True,
    )
