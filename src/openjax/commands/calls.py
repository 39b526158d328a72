"""The commands as functions: what `openjax.train(...)` and `openjax.evaluate(...)` do
in Python.
"""

import time
from collections.abc import Callable, Mapping
from pathlib import Path

import jax

from openjax.background import quiet_compiler
from openjax.cluster.processes import Processes
from openjax.errors import UserError
from openjax.learning import Learner, TrainSettings, preset
from openjax.policy import Network, Policy
from openjax.pursuit import Observation, Pursuit, PursuitSettings
from openjax.pursuit.evaders import Evader
from openjax.ranges import changed
from openjax.runs.job import OwnParts
from openjax.runs.start import TrainCommand, check_resumed, default_preset, start
from openjax.store.policies import LoadedPolicy, load_policy, own_controller
from openjax.store.run_directory import open_run


def train(
    settings: TrainSettings | None = None,
    out: str | Path | None = None,
    *,
    minutes: float | None = None,
    start_from: str | None = None,
    compare_with: str | None = None,
    devices: str = "1",
    vehicle: str | Path | None = None,
    effects: str | Path | None = None,
    overwrite: bool = False,
    resume: str | Path | None = None,
    environment: Pursuit | None = None,
    policy: Policy | Network | None = None,
    learners: Mapping[str, Learner] | None = None,
) -> LoadedPolicy:
    """Train as `openjax train` does, with its progress, checkpoints and pictures.

    Args:
      settings: of the run; None is the preset for this machine (`openjax.preset`).
      out: directory of the run; None is runs/DATE.
      minutes: of learning; compiling comes before, the report after.
      start_from: policy whose networks the run starts with.
      compare_with: policy that the final table and the animation show beside the
      trained one.
      devices: how many, or "all".
      vehicle, effects: files to fly with, vehicle.toml and effects.toml.
      overwrite: replace a run that `out` already holds.
      resume: directory of a run to go on with, in place of `out`; `settings` are its
      own by default, and parts of one's own are to be the same.
      environment: a game of one's own, with its evaders, reward, observations; its
      settings go before those of the run.
      policy: a network of one's own (`openjax.policy.Network`), or a whole policy.
      learners: of one's own by name (`openjax.learning.Learner`), beside the shipped
      ones, or in the place of `predictor`, `evaders` or `policy`, which is MAPPO.

    Returns:
      The best policy of the run.

    Raises:
      UserError: settings or files that can't be used, or a run that ended by a NaN.
    """
    saved_settings = None if resume is None else open_run(Path(resume)).read_settings()
    if resume is None and out is None:
        out = Path("runs") / time.strftime("%Y%m%d-%H%M%S")
    # by the command's own options, so that both are checked by the same code
    command = TrainCommand(
        out=_path(out),
        resume=_path(resume),
        minutes=minutes,
        start_from=start_from,
        compare_with=compare_with or "none",
        devices=str(devices),
        vehicle=_path(vehicle),
        effects=_path(effects),
        overwrite=overwrite,
        # a caller may have changed functions since they were loaded
        traced_programs=False,
        settings=settings or saved_settings or preset(default_preset()),
    )
    if saved_settings is not None:
        check_resumed(command, saved_settings)
    return _train(command, OwnParts(environment, policy, learners))


def _train(command, parts):
    """The policy of a run, as `train` gives it."""
    with quiet_compiler():
        status = start(command, ["(called from Python)"], time.monotonic(), Processes(), parts)
    run = command.resume or command.out
    if status:
        raise UserError(f"training in {run} stopped at a NaN; what is left to look at lies there")
    return load_policy(run, parts.environment, parts.policy)


def _path(name):
    return None if name is None else Path(name)


def evaluate(
    policy: LoadedPolicy | str | Path | Callable[[Observation], jax.Array],
    scenario: str = "all",
    *,
    episodes: int = 100,
    seed: int = 0,
    vehicle: str | Path | None = None,
    effects: str | Path | None = None,
    opponent: str | Path | Evader | None = None,
    **changes,
) -> dict | list[dict]:
    """Fly a policy's mean on layouts as `openjax evaluate` does.

    Args:
      policy: a loaded policy, what `openjax.load_policy` takes, or a pure function from
        the `Observation` of one world to actions (N, 4) in -1..1, which flies the
        nominal game.
      scenario: a layout's name, a TOML file with an own one, "uniform", or "all"; see
        `openjax evaluate --help`.
      episodes: per layout.
      seed: draws the start attitudes.
      vehicle, effects: files to fly with, vehicle.toml and effects.toml.
      opponent: evader to fly against: a name in `openjax.pursuit.evaders.SCRIPTED`, a
      file, or a function of one's own, velocity(scene, memory) -> velocity (3,) in m/s,
      memory (`openjax.pursuit.evaders.EvaderKind`); None: those of the policy's game.
      changes: of the game that the policy was trained in, for example
      speed_limit="none".

    Returns:
      A record, or a list of them for "all": scenario, episodes; capture_rate,
      crash_rate in 0..1; capture_step, and slowest_capture_step of the slowest
      hundredth, in control steps; collision_rate, collision_parts (pillar, drone,
      bounds) and over_speed_rate, each the share of steps in which any pursuer does so;
      prediction_error (m).

    Raises:
      UserError: an unusable layout, or a game that the policy can't play.
    """
    from openjax.commands.evaluate import EvaluateCommand, fly_scenarios

    if isinstance(policy, str | Path):
        policy = load_policy(policy)
    elif not isinstance(policy, LoadedPolicy):
        policy = own_controller(policy, changed(PursuitSettings(), **changes), "own controller")
    number = changes.pop("num_pursuers", None)
    command = EvaluateCommand(
        policy=(policy.source,),
        scenario=str(scenario),
        episodes=episodes,
        num_pursuers=number,
        seed=seed,
        vehicle=_path(vehicle),
        effects=_path(effects),
        opponent=str(opponent) if isinstance(opponent, Path) else opponent,
        environment=changed(policy.settings.environment, **changes),
    )
    records, _ = fly_scenarios(command, policy, {})
    return records if scenario == "all" else records[0]
