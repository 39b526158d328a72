"""A run's words: its training, and at its end the meaning of a crash, differences from the paper,
and the next commands.
"""

from pathlib import Path

from flax.traverse_util import flatten_dict

from openjax.command_line import as_typed
from openjax.files import to_plain
from openjax.learning import TrainSettings
from openjax.learning.presets import PRESETS
from openjax.pursuit import SCENARIOS, PursuitSettings, Scenario
from openjax.store.checkpoints import Checkpoints
from openjax.store.run_directory import RunDirectory

NAMED = 3
"""Most changed settings that are named."""


def opening_words(settings: TrainSettings) -> str:
    """Name and describe the preset that this is, or the nearest one: nobody should take another
    game for the paper's.
    """
    changes = {
        name: [leaf for leaf in different_settings(settings, make()) if leaf != "seed"]
        for name, make in PRESETS.items()
    }
    # the preset from which the fewest settings differ
    name = min(changes, key=lambda name: len(changes[name]))
    words = changes[name][:NAMED]
    if more := len(changes[name]) - len(words):
        words.append(f"{more} more")
    return (
        f"preset {name}{', changed in ' if words else ''}{', '.join(words)}: "
        f"{' '.join(PRESETS[name].__doc__.split())}"
    )


def different_settings(settings: TrainSettings, other: TrainSettings) -> list[str]:
    """The dotted names of settings that have another value."""
    mine, theirs = (flatten_dict(to_plain(one), sep=".") for one in (settings, other))
    return [name for name, value in mine.items() if value != theirs.get(name)]


def layouts_like(game: PursuitSettings) -> list[Scenario]:
    """The test layouts that a policy of this game can be judged by.

    They have its pursuers, and at most a fifth more pillars than it was trained with,
    as in the paper (6 for 5).
    """
    most = 1.2 * game.max_pillars
    return [
        layout
        for layout in SCENARIOS.values()
        if len(layout.pursuers) == game.num_pursuers and len(layout.pillars) <= most
    ]


def closing_words(
    settings: TrainSettings, run: Path, on_cpu: bool, own_network: bool = False
) -> list[str]:
    """Three lines below the table of the run in that directory. Commands don't know a
    network of one's own.
    """
    game = settings.environment
    seconds = game.episode_length * game.time_step
    lines = [
        "A crash: any drone touches the floor, a pillar or another drone, or tips over, at any "
        f"time of the {seconds:.0f} s, after the capture, too."
    ]
    if differs := unlike_the_papers(game, game.evaders):
        lines.append(differs)
    view = f"openjax view --policy {run}"
    if layouts := layouts_like(game):
        view += f" --scenario {layouts[-1].name}"
    steps = [f"{as_typed(view)} (in a browser)"]
    if own_network:
        steps = [f'openjax.load_policy("{run}", environment, network) in Python']
    if on_cpu:
        steps.append(as_typed("openjax train --preset paper (the real game, two minutes on a GPU)"))
    steps.append(f"{as_typed('openjax sample_flights flights')}, then")
    steps.append(as_typed("openjax diagnose flights (from flight logs to a cause)"))
    return [*lines, "\n  ".join(["Next:", *steps])]


def how_to_go_on(checkpoints: Checkpoints, directory: RunDirectory) -> str:
    """The state of a run that ends now, and the command that continues it."""
    update = checkpoints.last_finished()
    words = "nothing was learnt yet" if update is None else f"saved at update {update}"
    return f"{words}; go on with {as_typed(f'openjax train --resume {directory.path}')}"


def first_flights_words(summary: dict) -> str:
    """The result of the stage before MAPPO, by its validation."""
    return (
        f"the first flights alone catch {summary['capture_rate']:.0%} of the validation tasks and "
        f"crash in {summary['crash_rate']:.0%}; MAPPO goes on from there"
    )


def _pillars(game):
    """The number of pillars, as "4 to 5" or "5"."""
    return " to ".join(map(str, sorted({game.min_pillars, game.max_pillars})))


LENGTHS = {
    "evader_speed": "the evader flies {} m/s",
    "capture_radius": "captures within {} m",
    "arena_radius": "an arena of {} m",
}
"""Settings of a game in m or m/s, and what is said of another value."""


def _instead(what, value, usual):
    """A sentence's part, in a list; nothing where the value is the usual one."""
    if value == usual:
        return []
    return [f"{what.format(f'{value:g}')} instead of {usual:g}"]


def unlike_the_papers(game: PursuitSettings, evaders: tuple[str, ...]) -> str:
    """A sentence on a game's differences from the paper's; empty if there are none. `evaders`:
    names or files of those who fly, its own or others.
    """
    paper = PursuitSettings()
    words = []
    if evaders != paper.evaders:
        words.append(f"the evader is {' or '.join(dict.fromkeys(evaders))}")
    if game.vehicles:
        words.append("every pursuer is another vehicle")
    if game.speed_limit != paper.speed_limit:
        words.append("no clamp of the speed")
    for name, what in LENGTHS.items():
        words += _instead(what, getattr(game, name), getattr(paper, name))
    if game.num_pursuers != paper.num_pursuers:
        words.append(f"{game.num_pursuers} pursuers instead of {paper.num_pursuers}")
    if _pillars(game) != _pillars(paper):
        words.append(f"{_pillars(game)} pillars instead of {_pillars(paper)}")
    if game.observed_pillars != paper.observed_pillars:
        words.append(f"{game.observed_pillars} pillars in view instead of {paper.observed_pillars}")
    if game.start_attitude != paper.start_attitude:
        words.append("level starts instead of tilted ones")
    if game.time_step > paper.time_step:
        words.append(
            f"{1 / game.time_step:.0f} commands a second instead of {1 / paper.time_step:.0f}"
        )
    return f"Unlike the paper's game: {', '.join(words)}." if words else ""
