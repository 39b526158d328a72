"""The options of `openjax train`, without JAX, so that its help comes at once."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from openjax.learning.settings import TrainSettings
from openjax.ranges import Interval

PROGRAM = "openjax train"

MAY_CHANGE = ("total_steps", "validation_interval", "validation_episodes")
"""Settings that a resumed run may have otherwise; all else goes on as it was."""


@dataclasses.dataclass(frozen=True)
class TrainCommand:
    """Train pursuers to capture a faster evader.

    Every setting of the run can be given, such as --mappo.minibatches 8. The defaults shown are
    those of the preset quick, or of the one given: openjax train --preset paper --help.
    """

    preset: str | None = None
    """quick: minutes on two CPU cores, coarser steps; paper: the paper's task on an
    accelerator; flight: policies to be flown, every pursuer another vehicle; evaders:
    the same against evaders that fight back; teams: one policy for one to eight
    pursuers; mappo: without predictor and generator; dacoop: parameters of a potential
    field. By default quick without an accelerator, else paper.
    """
    config: Path | None = None
    """Settings to begin with (.toml or .json), which change those of the preset; a run's
    settings.json is one.
    """
    out: Path | None = None
    """Directory of the run; by default runs/DATE-PRESET."""
    steps: Annotated[int | None, Interval("[1, 1e15]")] = None
    """Environment steps of the whole run, short for --total_steps."""
    minutes: Annotated[float | None, Interval("(0, 1000000]")] = None
    """Learn for so long: compiling comes before it, the report after. A resumed run has it anew."""
    resume: Path | None = None
    """Go on with the run in this directory, exactly where it stopped."""
    start_from: str | None = None
    """Start with the networks of this policy (a run, a policy file or a name) instead
    of fresh ones.
    """
    overwrite: bool = False
    """Replace the run that --out already holds."""
    effects: Path | None = None
    """Physical effects to fly with (effects.toml, as the diagnosis writes it)."""
    vehicle: Path | None = None
    """Vehicle to fly: crazyflie, brushless, or a vehicle.toml, as the calibration
    writes it; by default the settings' airframe.
    """
    opponent: str | None = None
    """Evader to train against: field, greedy, wall_runner and others (openjax evaluate --help), or
    a file that openjax exploit wrote, or FILE.py:function; short for --environment.evaders.
    """
    devices: str | None = None
    """Number of devices to train on, or all (of all processes); by default one
    accelerator, or up to four cores.
    """
    coordinator_address: str | None = None
    """With several processes: host:port of process 0. Slurm and Open MPI tell it."""
    num_processes: Annotated[int | None, Interval("[1, 100000]")] = None
    """Number of processes that train together, for example one per host. Slurm and Open MPI
    tell it.
    """
    process_id: Annotated[int | None, Interval("[0, 99999]")] = None
    """This process' number, from 0. Slurm and Open MPI set it."""
    compilation_cache: bool = True
    """Keep traced and compiled programs in the user's cache folder, so that the next run
    starts sooner.
    """
    layout_episodes: Annotated[int | None, Interval("[1, 100000]")] = None
    """Episodes per layout in the final table; by default 100 on an accelerator, 32 on a
    CPU, and 1 where all are alike, as starts are level.
    """
    compare_with: str | None = None
    """Policy (a name, a file, a run) that the final table and the animation show beside
    the trained one, or none; by default open after the preset quick.
    """
    settings: Annotated[tyro.conf.FlagConversionOff[TrainSettings], tyro.conf.arg(name="")] = (
        dataclasses.field(default_factory=TrainSettings)
    )
