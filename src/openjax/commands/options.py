"""Options of the commands that compile for long, without JAX, so that their help comes at once."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal, get_args

import tyro

from openjax.evaluation.judges.settings import BestResponseSettings, PlannerSettings
from openjax.evaluation.message_settings import MessageSettings
from openjax.learning.settings import AdaptSettings, TrainSettings
from openjax.pursuit.evaders.kinds import HELD_OUT
from openjax.pursuit.settings import PursuitSettings
from openjax.ranges import Interval, Seed
from openjax.store import DEFAULT_POLICY, TEAM_POLICY


@dataclasses.dataclass(frozen=True)
class ExploitCommand:
    """Train evaders against a fixed policy, and count the captures of them and of all
    scripted evaders.
    """

    policy: str | None = None
    """A run's directory, a policy file (.npz), a checkpoint, the name of a policy in the package or
    of a heuristic, or FILE.py:function for a controller of one's own. By default evaders, or teams
    for another number of pursuers than three, another speed of the evader, capture radius or arena.
    """
    out: Path = Path("evader.npz")
    """File to write the strongest learned evader to."""
    json: Path | None = None
    """File to write the records to."""
    episodes: Annotated[int, Interval("[1, 1000000]")] = 100
    """Episodes per layout and evader; by default 2 on a CPU."""
    uniform: Annotated[int, Interval("[1, 1000000]")] = 256
    """Uniform tasks per evader; by default 8 on a CPU."""
    seed: Seed = 0
    """Draws the evaders' first parameters, their tasks and the start attitudes."""
    minutes: Annotated[float | None, Interval("(0, 100000]")] = None
    """Stop learning after this time, which begins when all is compiled; by default only
    when all steps are done.
    """
    compilation_cache: bool = True
    """Keep compiled programs in the user's cache folder."""
    vehicle: Path | None = None
    """Vehicle to fly (vehicle.toml); by default the nominal Crazyflie."""
    effects: Path | None = None
    """Physical effects to fly with (effects.toml)."""
    planner: tyro.conf.FlagConversionOff[bool] = True
    """Fly an evader that plans in the true simulation, too."""
    planning: PlannerSettings = dataclasses.field(default_factory=PlannerSettings)
    learning: Annotated[BestResponseSettings, tyro.conf.arg(name="")] = dataclasses.field(
        default_factory=BestResponseSettings
    )
    environment: tyro.conf.FlagConversionOff[PursuitSettings] = dataclasses.field(
        default_factory=PursuitSettings
    )


@dataclasses.dataclass(frozen=True)
class MapCommand:
    """Map what a policy catches: over teams, speeds of the evader and capture radii."""

    policy: str = TEAM_POLICY
    """A run's directory, a policy file (.npz), a checkpoint, or the name of a policy in
    the package; one of the preset teams flies with any number of pursuers.
    """
    out: Path = Path("map.png")
    """File for the picture: a small map for each size of team."""
    page: Path | None = None
    """File for a page to move about in (.html), for a reader who knows no game theory."""
    json: Path | None = None
    """File to write all cells to."""
    sizes: Annotated[tuple[int, ...], Interval("[1, 8]")] = (1, 2, 3, 4, 5, 6, 7, 8)
    """Numbers of pursuers."""
    speed_ratios: Annotated[tuple[float, ...], Interval("(0, 10]")] = (
        *(0.8, 1.0, 1.2, 1.4, 1.6, 2.0, 2.5, 3.0),
    )
    """Speeds of the evader, as multiples of the pursuers' maximal one."""
    radii: Annotated[tuple[float, ...], Interval("(0, 10]")] = (
        *(0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5),
    )
    """Capture radii (m)."""
    scenario: Literal["empty", "uniform"] = "empty"
    """Uniform tasks, with their pillars or without."""
    arena_radius: Annotated[float, Interval("[0.1, 100]")] = PursuitSettings.arena_radius
    """Radius of the arena (m)."""
    evaders: tuple[str, ...] = HELD_OUT
    """One of them is drawn for each episode; by default those that no preset trains with."""
    episodes: Annotated[int, Interval("[1, 1000000]")] = 200
    """Episodes of each cell."""
    messages: MessageSettings = dataclasses.field(default_factory=MessageSettings)
    fall_outs: Annotated[float, Interval("[0, 1]")] = 0.0
    """Share of the episodes of two or more pursuers in which one of them is gone after 2 s."""
    sight_range: Annotated[float, Interval("(0, 1000]")] = PursuitSettings.sight_range
    """Distance up to which a pursuer sees the evader (m)."""
    sight_angle: Annotated[float, Interval("(0, 360]")] = PursuitSettings.sight_angle
    """Opening angle of the cone about its body x axis within which a pursuer sees it (degrees)."""
    best_response: tyro.conf.FlagConversionOff[bool] = True
    """Let evaders learn against the policy, one network for all cells, and fly them in
    all cells, too; by default not on a CPU.
    """
    learned: Path | None = None
    """File of evaders that learned in a map before (--evaders_out), in place of learning."""
    evaders_out: Path | None = None
    """File to write those that learned to (.npz)."""
    minutes: Annotated[float | None, Interval("(0, 100000]")] = None
    """Stop learning after this time, which begins when all is compiled."""
    learning: BestResponseSettings = dataclasses.field(
        default_factory=lambda: BestResponseSettings(
            learners=4, total_steps=400_000_000, looks=(), num_envs=1024, layouts=0.0
        )
    )
    """Settings of their learning; tasks are the map's, and `layouts` has no effect."""
    planner_share: Annotated[float, Interval("[0, 1]")] = 0.1
    """Share of the cells in which an evader that plans flies, too."""
    planner_episodes: Annotated[int, Interval("[1, 1000000]")] = 50
    """Its episodes in each of them, the first of the cell's: each takes hundreds of others."""
    planning: PlannerSettings = dataclasses.field(default_factory=PlannerSettings)
    batch: Annotated[int, Interval("[1, 1000000]")] = 8192
    """Episodes that are flown at once."""
    seed: Seed = 0
    """Draws the tasks, which are the same in all cells, and the evaders."""
    compilation_cache: bool = True
    """Keep compiled programs in the user's cache folder."""


@dataclasses.dataclass(frozen=True)
class AdaptCommand:
    """Diagnose flights and fine-tune a policy to the vehicle that flew them."""

    flights: Annotated[Path, tyro.conf.Positional] = Path("flights")
    """Folder of flight logs with a vehicle.toml, or an effects.toml of a diagnosis made before."""
    policy: str = DEFAULT_POLICY
    """A run, a policy file or the name of a policy in the package."""
    out: Path = Path("adapted")
    """Directory for what is found."""
    episodes: Annotated[int | None, Interval("[1, 1000000]")] = None
    """Episodes by which the policies are measured; by default 1024 on an accelerator,
    128 on a CPU.
    """
    seed: Seed = 0
    """Draws the worlds in which the policy is fine-tuned and measured."""
    overwrite: bool = False
    """Replace what --out already holds."""
    compilation_cache: bool = True
    """Keep compiled programs in the user's cache folder."""
    training: AdaptSettings = dataclasses.field(default_factory=AdaptSettings)


Part = Literal["rigid_free", "rigid", "mjx_free", "mjx", "environment", "rollout", "training"]
PARTS = get_args(Part)


@dataclasses.dataclass(frozen=True)
class BenchmarkCommand:
    """Measure steps per second of each layer, from the physics to the whole training step."""

    preset: str | None = None
    """quick, paper, flight, mappo or dacoop: networks and learner; by default what fits
    the machine.
    """
    envs: Annotated[tuple[int, ...], Interval("[1, 16777216]")] = ()
    """Environment counts; by default a sweep that fits the machine."""
    training_envs: Annotated[tuple[int, ...], Interval("[1, 16777216]")] = ()
    """Environment counts of the training step; by default those that fit the machine."""
    devices: Annotated[tuple[int, ...], Interval("[1, 65536]")] = (1,)
    """Numbers of devices on which the training step is measured; its worlds are shared
    out to them.
    """
    parts: tuple[Part, ...] = PARTS
    """Parts to measure."""
    steps: Annotated[int, Interval("[1, 100000]")] = 50
    """Control steps per call of physics, environment and rollout."""
    seconds: Annotated[float, Interval("(0, 3600]")] = 1.0
    """Shortest time to measure each."""
    json: Path = Path("benchmark.json")
    """File of the results."""
    settings: Annotated[tyro.conf.FlagConversionOff[TrainSettings], tyro.conf.arg(name="")] = (
        dataclasses.field(default_factory=TrainSettings)
    )
