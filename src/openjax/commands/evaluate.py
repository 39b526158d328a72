"""Evaluate a policy: `openjax evaluate --policy PATH --scenario NAME|FILE.toml`.

Prints, and with `--json` writes, for each scenario: scenario, episodes, capture_rate,
capture_step, slowest_capture_step (of the slowest hundredth of the episodes),
collision_rate, collision_parts, crash_rate, over_speed_rate, prediction_error. From
Python: `openjax.evaluate(policy, scenario)`, see `openjax.commands.calls.evaluate`.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from openjax.command_line import output_console, parse
from openjax.errors import UserError
from openjax.evaluation.message_settings import MessageSettings
from openjax.files import check_output, write_json
from openjax.pursuit.settings import LAYOUT_PURSUERS, PursuitSettings
from openjax.ranges import Interval, Seed
from openjax.show.progress import Steps
from openjax.store import default_policy
from openjax.store.compiled_programs import cache_programs

if TYPE_CHECKING:
    from openjax.evaluation.evaluator import Flown
    from openjax.store.policies import LoadedPolicy

PROGRAM = "openjax evaluate"
COMPILING = 15.0
"""Seconds that a policy's game takes to compile on a laptop, about."""
LARGEST_BATCH = 1000
"""Episodes that are flown at once, whose paths are all kept."""


@dataclasses.dataclass(frozen=True)
class FlightOptions:
    """The flights of a command: policies on layouts, against an evader."""

    policy: tuple[str, ...] | None = None
    """Runs' directories, policy files (.npz), checkpoints, or names of policies in the package
    (flight, open ...) or of heuristics (angelani, janosov, apf, stack), or FILE.py:function for a
    controller of one's own. By default evaders, or teams for another number of pursuers than three,
    another speed of the evader, capture radius or arena.
    """
    scenario: str = "all"
    """wall, narrow_gap, random, passage, empty, hidden, a TOML file with an own layout,
    uniform (another task in each episode, as in the validation of a run), or all six;
    these have three pursuers: a policy of another number flies uniform instead.
    """
    num_pursuers: Annotated[int | None, Interval("[1, 8]")] = None
    """Pursuers; by default as many as in training. A policy for teams of any size flies three by
    default, all episodes with one evader's speed, one capture radius and one arena.
    """
    seed: Seed = 0
    """Draws the start attitudes."""
    opponent: str | None = None
    """Evader to fly against: field, greedy, wall_runner, slow_hugger, heavy, pillar_hugger,
    greedy_far, greedy_near, two_step, safe_place, way_points, frozen, a file that openjax exploit
    wrote, or a function of one's own, FILE.py:function; by default those of the policy's game.
    """
    compilation_cache: bool = True
    """Keep compiled programs in the user's cache folder."""

    def start(self, environment: PursuitSettings | None = None) -> list["LoadedPolicy"]:
        """The policies, loaded, after JAX was told where it keeps programs. Raises UserError where
        there are none. `environment`: settings that were typed; None: none were.
        """
        if self.compilation_cache:
            cache_programs()
        from openjax.store.policies import load_policy

        names = self.policy
        if names is None:
            game = environment or PursuitSettings()
            if self.num_pursuers is not None:
                game = dataclasses.replace(game, num_pursuers=self.num_pursuers)
            number = self.pursuers_of(game)
            name, line = default_policy(dataclasses.replace(game, num_pursuers=number))
            names = (name,)
            if line:
                output_console().print(line, soft_wrap=True)
        if not names:
            raise UserError("--policy needs at least one policy")
        return [load_policy(name) for name in names]

    def pursuers_of(self, environment: PursuitSettings) -> int:
        """The number of pursuers asked for: that of a layout's file, or of the settings.

        Raises:
          UserError: an unusable file.
        """
        from openjax.pursuit.scenarios import find_scenario

        if self.scenario.endswith(".toml"):
            return len(find_scenario(self.scenario, environment).pursuers)
        return environment.num_pursuers


@dataclasses.dataclass(frozen=True)
class EvaluateCommand(FlightOptions):
    """Fly a policy's mean on a layout and count captures, collisions and crashes.

    The game is the one that the policy was trained in; any --environment.setting can be changed,
    for example --environment.speed_limit none or --environment.start_attitude level. Of several
    policies, for example one per training seed, mean and standard deviation are shown too.
    """

    episodes: Annotated[int, Interval("[1, 1000000]")] = 100
    """Episodes per scenario."""
    messages: MessageSettings = dataclasses.field(default_factory=MessageSettings)
    json: Path | None = None
    """File to write the records to: an object for one scenario, a list for all."""
    vehicle: Path | None = None
    """Vehicle to fly: crazyflie, brushless, or a vehicle.toml; by default the airframe
    that the policy was trained for.
    """
    effects: Path | None = None
    """Physical effects to fly with (effects.toml)."""
    environment: tyro.conf.FlagConversionOff[PursuitSettings] = dataclasses.field(
        default_factory=PursuitSettings
    )


def main(arguments: Sequence[str]) -> int:
    """The command; returns its exit status."""
    command = parse(EvaluateCommand, EvaluateCommand(), arguments, PROGRAM)
    evaluators = {}
    results = []
    for options, policy in prepare(command, arguments):
        records = [kind.record() for kind in fly_scenarios(options, policy, evaluators)]
        results.append((options, policy.source, records))
    _show(command, results)
    return 0


def prepare(command: EvaluateCommand, arguments: Sequence[str]) -> list[tuple]:
    """Each policy, and the command with that policy's own game as the default; all that
    can be wrong was looked at.

    Raises:
      UserError: an unusable file or layout, or a game that a policy can't play.
    """
    check_output(command.json, "--json")
    policies = []
    for policy in command.start(command.environment):
        # of one team, so that any number of pursuers may be typed
        game = policy.of_team(LAYOUT_PURSUERS).settings.environment
        default = dataclasses.replace(EvaluateCommand(), environment=game)
        options = parse(EvaluateCommand, default, arguments, PROGRAM)
        find_game(options, policy)
        policies.append((options, policy))
    return policies


def fly_scenarios(command: EvaluateCommand, policy, evaluators: dict) -> list["Flown"]:
    """The episodes of each scenario.

    Args:
      command: what to fly, with the game's settings.
      policy: which flies.
      evaluators: those already compiled, to be used again for policies of the same
      kind.

    Raises:
      UserError: an unusable layout, or a game that the policy can't play.
    """
    import jax

    from openjax.evaluation.evaluator import Evaluator, layout_tasks
    from openjax.evaluation.judges.tasks import JUDGE_KEY
    from openjax.evaluation.validation import uniform_tasks

    game, policy, layouts = find_game(command, policy)
    if words := policy.outside_of_training(game):
        note = f"note: {policy.source} was never trained for this: {'; '.join(words)}"
        output_console().print(note, soft_wrap=True)
    tasks = layout_tasks(game.settings, layouts, command.episodes)
    if not layouts:
        settings = _settings(command)
        slots = game.settings.max_pillars
        # not those by which runs choose their checkpoints
        tasks["uniform"] = uniform_tasks(settings, command.episodes, slots, JUDGE_KEY)
    kind = (game.settings, policy.policy, command.opponent, command.messages)
    is_compiled = kind in evaluators
    if not is_compiled:
        batch = min(command.episodes, LARGEST_BATCH)
        evaluators[kind] = Evaluator(game, policy.policy, batch, command.messages)
    # seconds of an episode on a laptop, about
    durations = dict.fromkeys(tasks, 0.02 * command.episodes)
    first = next(iter(tasks))
    if not is_compiled:
        durations[first] += COMPILING
    with Steps(f"flying {policy.source}", durations, output_console()) as steps:

        def tell(layout):
            steps.begin(layout, "compiled first" if not is_compiled and layout == first else "")

        return evaluators[kind].fly(policy.parameters, tasks, jax.random.key(command.seed), tell)


def _settings(command):
    """The settings of the command's game, of one size of team."""
    settings = command.environment
    number = command.num_pursuers
    if settings.team_sizes:
        return settings.of_one_team(number or LAYOUT_PURSUERS)
    return settings if number is None else dataclasses.replace(settings, num_pursuers=number)


def find_game(command: EvaluateCommand, policy: "LoadedPolicy") -> tuple:
    """The game of a command, the policy in it, and the layouts; none: uniform tasks.

    Raises:
      UserError: an unusable layout, or a game that the policy can't play.
    """
    from openjax.evaluation.evaluator import layout_slots
    from openjax.pursuit.scenarios import SCENARIOS, find_scenario

    settings = _settings(command)
    if "learned" in settings.evaders and command.opponent is None:
        raise UserError(
            "--environment.evaders learned needs a file: give --opponent one that openjax exploit "
            "wrote"
        )
    if not command.messages.perfect and policy.is_heuristic:
        raise UserError(
            f"--messages: {policy.source} flies the team as one; only trained policies fly "
            "each pursuer by what it knows"
        )
    number = settings.num_pursuers
    team_size = number if policy.any_number else policy.settings.environment.num_pursuers
    layouts = []
    if command.scenario == "all":
        layouts = [layout for layout in SCENARIOS.values() if len(layout.pursuers) == team_size]
    elif command.scenario != "uniform":
        layouts = [find_scenario(command.scenario, settings)]
    in_layout = len(layouts[0].pursuers) if layouts else number
    if command.num_pursuers not in (None, in_layout):
        raise UserError(
            f"--num_pursuers {command.num_pursuers}: layout {layouts[0].name} has {in_layout}; "
            "--scenario uniform flies any number"
        )
    # a number that nobody typed is the policy's own, which a layout goes before
    if number not in (team_size, in_layout):
        raise UserError(
            f"--environment.num_pursuers {number}: layout {layouts[0].name} has {in_layout} "
            "pursuers"
        )
    # one number of slots for all layouts: their episodes share one program
    slots = max([layout_slots(settings), *(len(layout.pillars) for layout in layouts)])
    game = dataclasses.replace(settings, max_pillars=slots, num_pursuers=in_layout)
    environment = _environment(command, game, policy)
    return environment, policy.in_game(environment), layouts


def _environment(command, game, policy):
    """The game with all that the command, or a policy of a game of one's own, adds to it."""
    from openjax.store.environments import make_environment

    trained_in = policy.environment
    if trained_in is None:
        return make_environment(game, command.vehicle, command.effects, command.opponent)
    if trained_in.evaders and not command.opponent:
        # these come below
        game = dataclasses.replace(game, evaders=PursuitSettings().evaders)
    environment = make_environment(game, command.vehicle, command.effects, command.opponent)
    evaders = environment.evaders if command.opponent else trained_in.evaders
    return dataclasses.replace(environment, observer=trained_in.observer, evaders=evaders)


def _show(command, results):
    """Print the tables and write the file: a record, a list of them, or such a list by policy."""
    from openjax.evaluation.result_tables import results_table, spread_table
    from openjax.runs.words import unlike_the_papers

    console = output_console()
    for options, source, rows in results:
        settings = _settings(options)
        evaders = (options.opponent,) if options.opponent else settings.evaders
        game = unlike_the_papers(settings, evaders)
        console.print(results_table(f"{source}, mean policy, seed {command.seed}", rows, game))
    if len(results) > 1:
        console.print(spread_table([rows for *_, rows in results]))
    if command.json is not None:
        by_policy = {
            source: rows if command.scenario == "all" else rows[0] for _, source, rows in results
        }
        results_of_one = next(iter(by_policy.values()))
        write_json(command.json, results_of_one if len(results) == 1 else by_policy)
