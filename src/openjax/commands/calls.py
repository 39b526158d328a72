"""The commands as functions: what `openjax.train(...)` and `openjax.evaluate(...)` do in Python."""

import dataclasses
import inspect
import time
import typing
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from openjax.background import quiet_compiler
from openjax.cluster.processes import Processes
from openjax.commands.evaluate import EvaluateCommand, fly_scenarios
from openjax.errors import UserError
from openjax.learning import TrainSettings, preset
from openjax.pursuit import Observation, PursuitSettings
from openjax.pursuit.evaders import Evader
from openjax.ranges import changed, check_intervals
from openjax.runs.job import OwnParts
from openjax.runs.request import check_resumed, default_preset
from openjax.runs.start import start
from openjax.runs.train_command import TrainCommand
from openjax.store.policies import LoadedPolicy, load_policy, own_controller
from openjax.store.run_directory import open_run


def _with_fields(*kinds: type) -> Callable:
    """Have a function's signature show the fields of dataclasses, which it takes as keywords."""

    def show(function):
        signature = inspect.signature(function)
        *parameters, others = signature.parameters.values()
        names = {parameter.name for parameter in parameters}
        for kind in kinds:
            for field in dataclasses.fields(kind):
                if field.name not in names and field.default is not dataclasses.MISSING:
                    names.add(field.name)
                    parameters.append(
                        inspect.Parameter(
                            field.name,
                            inspect.Parameter.KEYWORD_ONLY,
                            default=field.default,
                            annotation=field.type,
                        )
                    )
        function.__signature__ = signature.replace(parameters=[*parameters, others])
        return function

    return show


@_with_fields(OwnParts, TrainCommand)
def train(
    settings: TrainSettings | None = None,
    out: str | Path | None = None,
    **options: Any,
) -> LoadedPolicy:
    """Train as `openjax train` does, with its progress, checkpoints and pictures.

    Args:
      settings: of the run; None is the preset for this machine (`openjax.preset`).
      out: directory of the run; None is runs/DATE.
      options: those of `openjax train` (`openjax.runs.train_command.TrainCommand`), such
      as minutes, start_from, vehicle, effects, overwrite or resume; and what only Python
      has (`openjax.runs.job.OwnParts`): environment, policy and learners of one's own, and
      on_record.

    Returns:
      The best policy of the run.

    Raises:
      UserError: settings or files that can't be used, or a run that ended by a NaN.
    """
    names = [field.name for field in dataclasses.fields(OwnParts)]
    parts = OwnParts(**{name: options.pop(name) for name in names if name in options})
    command = _command_of(TrainCommand, {**options, "out": out})
    if command.resume is None and command.out is None:
        command = dataclasses.replace(command, out=Path("runs") / time.strftime("%Y%m%d-%H%M%S"))
    stored_settings = None if command.resume is None else open_run(command.resume).read_settings()
    command = dataclasses.replace(
        command,
        # nobody reads a table, and other work may be on the other cores
        compare_with=command.compare_with or "none",
        devices=command.devices or "1",
        settings=settings or stored_settings or preset(command.preset or default_preset()),
    )
    if stored_settings is not None:
        check_resumed(command, stored_settings)
    with quiet_compiler():
        status = start(command, ["(called from Python)"], time.monotonic(), Processes(), parts)
    run = command.resume or command.out
    if status:
        raise UserError(f"training in {run} stopped at a NaN; its state is kept there")
    return load_policy(run, parts.environment, parts.policy)


def _command_of(kind, options):
    """A command with these options, whose paths may be text. Raises UserError for one that
    it doesn't have, or a number outside its interval.
    """
    hints = typing.get_type_hints(kind)
    values = {
        name: Path(value) if Path in typing.get_args(hints.get(name)) else value
        for name, value in options.items()
        if value is not None
    }
    if "devices" in values:
        values["devices"] = str(values["devices"])
    command = changed(kind(), **values)
    check_intervals(command)
    return command


@_with_fields(EvaluateCommand)
def evaluate(
    policy: LoadedPolicy | str | Path | Callable[[Observation], jax.Array],
    scenario: str | Path = "all",
    *,
    opponent: str | Path | Evader | None = None,
    **options: Any,
) -> dict | list[dict]:
    """Fly a policy's mean on layouts as `openjax evaluate` does.

    Args:
      policy: a loaded policy, what `openjax.load_policy` takes, or a pure function from
        the `Observation` of one world to actions (N, 4) in -1..1, which flies the
        nominal game.
      scenario: a layout's name, a TOML file with an own one, "uniform", or "all"; see
        `openjax evaluate --help`.
      opponent: evader to fly against: a name in `openjax.pursuit.evaders.SCRIPTED`, a
      file, or a function of one's own, velocity(scene, memory) -> velocity (3,) in m/s,
      memory (`openjax.pursuit.evaders.EvaderKind`); None: those of the policy's game.
      options: those of `openjax evaluate` (`openjax.commands.evaluate.EvaluateCommand`),
      such as episodes, seed, vehicle or effects; and changes of the game that the policy
      was trained in, such as speed_limit="none".

    Returns:
      A record, or a list of them for "all": scenario, episodes; capture_rate,
      crash_rate in 0..1; capture_step, and slowest_capture_step of the slowest
      hundredth, in control steps; collision_rate, collision_parts (pillar, drone,
      bounds) and over_speed_rate, each the share of steps in which any pursuer does so;
      prediction_error (m).

    Raises:
      UserError: an unusable layout, or a game that the policy can't play.
    """
    names = [field.name for field in dataclasses.fields(EvaluateCommand)]
    changes = {name: options.pop(name) for name in list(options) if name not in names}
    if isinstance(policy, str | Path):
        policy = load_policy(policy)
    elif not isinstance(policy, LoadedPolicy):
        number = {name: options[name] for name in options if name == "num_pursuers"}
        game = changed(PursuitSettings(), **changes, **number)
        policy = own_controller(policy, game, "own controller")
    command = dataclasses.replace(
        _command_of(EvaluateCommand, {**options, "scenario": str(scenario)}),
        policy=(policy.source,),
        opponent=str(opponent) if isinstance(opponent, Path) else opponent,
        environment=changed(policy.settings.environment, **changes),
    )
    records = [kind.record() for kind in fly_scenarios(command, policy, {})]
    return records if scenario == "all" else records[0]
