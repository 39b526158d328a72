"""Evaluate a policy: `python -m openjax.evaluate --policy PATH --scenario NAME|FILE.toml`.

Prints, and with `--json` writes, for each scenario: scenario, episodes, capture_rate, capture_step,
collision_rate, collision_parts, crash_rate, over_speed_rate, prediction_error.
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

import tyro

from openjax.errors import UserError
from openjax.pursuit import SCENARIOS, PursuitSettings, find_scenario
from openjax.runs.command_line import output_console, parse, peek, run_command

PROGRAM = "python -m openjax.evaluate"


@dataclasses.dataclass(frozen=True)
class EvaluateCommand:
    """Fly a policy's mean on a layout and count captures, collisions and crashes.

    The game is the one that the policy was trained in; any --environment.setting can be changed, for example
    --environment.speed_limit none or --environment.start_attitude level.
    """

    policy: str = "open"
    """A run's directory, a policy file (.npz), a checkpoint, or the name of a policy in the package."""
    scenario: str = "all"
    """wall, narrow_gap, random, passage, empty, hidden, a TOML file with an own layout, or all six."""
    episodes: int = 100
    """Episodes per scenario."""
    seed: int = 0
    """Draws the start attitudes."""
    json: Path | None = None
    """File to write the records to: an object for one scenario, a list for all."""
    vehicle: Path | None = None
    """Vehicle to fly (vehicle.toml); by default the nominal Crazyflie."""
    effects: Path | None = None
    """Physical effects to fly with (effects.toml)."""
    environment: tyro.conf.FlagConversionOff[PursuitSettings] = dataclasses.field(
        default_factory=PursuitSettings
    )


def main(arguments: Sequence[str]) -> int:
    """The command; returns its exit status."""
    from openjax.runs.policies import load_policy

    default = EvaluateCommand()
    loaded = None
    if not {"-h", "--help"} & set(arguments):
        loaded = load_policy(peek(arguments, "policy") or default.policy)
        default = dataclasses.replace(default, environment=loaded.settings.environment)
    command = parse(EvaluateCommand, default, arguments, PROGRAM)
    rows = evaluate(command, loaded)
    return _show(command, rows)


def evaluate(command: EvaluateCommand, loaded) -> list[dict]:
    """One record per scenario; see `openjax.runs.evaluation.FIELDS`.

    Raises:
      UserError: an unusable layout, or one with another number of pursuers than a policy can fly.
    """
    from openjax.runs.environments import make_environment
    from openjax.runs.evaluation import Evaluator, evaluate_scenarios, layout_slots

    if command.episodes < 1:
        raise UserError(f"--episodes is {command.episodes}; it must be positive")
    if command.json is not None and not command.json.parent.is_dir():
        raise UserError(f"--json {command.json}: the directory {command.json.parent} doesn't exist")
    settings = command.environment
    if command.scenario == "all":
        scenarios = list(SCENARIOS.values())
    else:
        scenarios = [find_scenario(command.scenario, settings)]
    slots = max(layout_slots(settings), *(len(scenario.pillars) for scenario in scenarios))
    settings = dataclasses.replace(settings, max_pillars=slots, num_pursuers=len(scenarios[0].pursuers))
    _check_sizes(settings, loaded.settings.environment)
    environment = make_environment(settings, command.vehicle, command.effects)
    evaluator = Evaluator(environment, loaded.policy, command.episodes)
    return evaluate_scenarios(evaluator, loaded.parameters, scenarios, command.episodes, command.seed)[0]


def _check_sizes(settings, trained):
    """Settings that shape the networks' inputs can't differ from those of the training."""
    for name in ("self_size", "observed_pillars", "history_length", "frame_size"):
        if getattr(settings, name) != getattr(trained, name):
            raise UserError(
                f"the policy was trained with {name} {getattr(trained, name)}, here it's "
                f"{getattr(settings, name)}: pursuers, observation and history must stay as in training"
            )


def _show(command, rows):
    from openjax.runs.evaluation import results_table
    from openjax.runs.settings_files import write_json

    console = output_console()
    console.print(results_table(f"{command.policy}, mean policy, seed {command.seed}", rows))
    if command.json is not None:
        write_json(command.json, rows if command.scenario == "all" else rows[0])
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
