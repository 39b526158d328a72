"""Policies from wherever they lie: a policy file, a run, a checkpoint, or one shipped
with the package.
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path

import jax

from openjax.baselines import METHODS, CraftPolicy, Heuristic
from openjax.baselines.heuristic import OwnController
from openjax.baselines.surroundings import Craft
from openjax.baselines.velocity_controller import check_flyable
from openjax.errors import UserError, suggestion
from openjax.learning import TrainSettings, build
from openjax.learning.train_state import policy_leaf
from openjax.plain import from_plain
from openjax.policy import (
    MixedPolicy,
    Network,
    NetworkSettings,
    OwnPolicy,
    Policy,
    PolicyParameters,
    PredictorSettings,
    make_policy,
)
from openjax.pursuit import Observation, Pursuit, PursuitSettings
from openjax.pursuit.evaders import SCRIPTED
from openjax.store import DEFAULT_POLICY
from openjax.store.checkpoint_files import is_checkpoint, load_arrays
from openjax.store.checkpoints import Checkpoints
from openjax.store.leaves import named_leaves
from openjax.store.own_code import is_own_code, own_code
from openjax.store.policy_files import WEIGHTS, fill, load_policy_file, shipped_policies
from openjax.store.run_directory import RunDirectory, is_run, open_run

_OF_THE_WORLD = (
    "arena_radius",
    "arena_height",
    "pillar_radius",
    "capture_radius",
    "evader_speed",
    "max_speed",
    "time_step",
)
"""Settings that a policy can't see, and is used to."""
_DRAWN = {
    "evader_speed": "evader_speeds",
    "capture_radius": "capture_radii",
    "arena_radius": "arena_radii",
}
"""Those of them that a training may draw, and from where; a policy for teams sees
them.
"""


@dataclasses.dataclass(frozen=True, eq=False)
class LoadedPolicy:
    """A trained policy or a heuristic, called with observations of its game:
    `openjax.make(policy.settings.environment)`.

    It goes into `jax.jit` and `jax.vmap` as it is; two are the same only if they're one
    object.
    """

    policy: Policy | Heuristic | OwnController
    parameters: PolicyParameters
    settings: TrainSettings
    """The settings of its training; of a heuristic, the game's defaults."""
    source: str
    environment: Pursuit | None = None
    """Its game, where that has parts of one's own; None: the one that the settings
    name.
    """

    @property
    def is_heuristic(self) -> bool:
        """True if the policy was written and not trained."""
        return isinstance(self.policy, Heuristic)

    @property
    def any_number(self) -> bool:
        """True if the policy flies with any number of pursuers."""
        return bool(self.settings.environment.team_sizes)

    def of_team(self, number: int) -> "LoadedPolicy":
        """The policy in the game of so many pursuers; itself where it flies with one
        number only.
        """
        if not self.any_number:
            return self
        game = self.settings.environment.of_one_team(number)
        return dataclasses.replace(
            self, settings=dataclasses.replace(self.settings, environment=game)
        )

    def in_game(self, environment: Pursuit) -> "LoadedPolicy":
        """The policy for another game than its own: another arena, vehicle or number of
        pillars.

        Raises:
          UserError: it can't play that one.
        """
        if isinstance(self.policy, Heuristic):
            policy = Heuristic.for_environment(self.policy.name, environment)
            return dataclasses.replace(self, policy=policy)
        if isinstance(self.policy, OwnController):
            return self  # it takes what it is given
        game = environment.settings
        game_of_training = self.settings.environment
        names = [
            "self_size",
            "observe_in",
            "observed_pillars",
            "history_length",
            "frame_size",
            "strategies",
        ]
        if not self.any_number:
            names.insert(0, "num_pursuers")  # first, as the sizes follow from it
        for name in names:
            value = getattr(game_of_training, name)
            if getattr(game, name) != value:
                raise UserError(
                    f"policy {self.source} was trained with {name} {value}, here it's "
                    f"{getattr(game, name)}: pursuers, observation and history must stay as in "
                    "training"
                )
        # its controller flies another arena, or vehicle
        if isinstance(self.policy, CraftPolicy):
            craft = Craft.of(environment)
            check_flyable(
                f"the policy's output {self.settings.network.output}", craft, game.time_step
            )
            return dataclasses.replace(self, policy=dataclasses.replace(self.policy, craft=craft))
        return self

    def outside_of_training(self, environment: Pursuit) -> list[str]:
        """In words, how a game differs from all that the policy was trained in: arena,
        radii, speeds, steps and vehicle. A heuristic, and a controller of one's own,
        learned in none.
        """
        if not isinstance(self.policy, Policy | MixedPolicy | OwnPolicy):
            return []
        game = environment.settings
        game_of_training = self.settings.environment
        words = []
        for name in _OF_THE_WORLD:
            value = getattr(game, name)
            ends = getattr(game_of_training, _DRAWN.get(name, ""), ()) or (
                getattr(game_of_training, name),
            )
            if not ends[0] <= value <= ends[-1]:
                span = " to ".join(f"{end:g}" for end in ends)
                words.append(f"{name} {value:g} instead of {span}")
        if self.any_number and game.num_pursuers not in game_of_training.team_sizes:
            words.append(f"{game.num_pursuers} pursuers, which no team in training had")
        if game.airframe != game_of_training.airframe:
            words.append(f"the {game.airframe} instead of the {game_of_training.airframe}")
        elif environment.effects and not game_of_training.vehicles:
            words.append(f"{', '.join(environment.effects)}, which no vehicle in training had")
        return words

    def __call__(self, observation: Observation) -> jax.Array:
        """The mean policy's action (..., N, 4) in -1..1: collective thrust, roll, pitch
        and yaw rate.

        Raises:
          UserError: the observation is that of another game.
        """
        game = self.settings.environment
        if self.environment is not None:  # what it observes may be anything
            return self.policy.act(self.parameters, observation)
        axes = "world" if observation.heading is None else "heading"
        sizes = (observation.self_state.shape[-1], *observation.frames.shape[-2:], axes)
        sizes_of_policy = (game.self_size, game.history_length, game.frame_size, game.observe_in)
        if sizes != sizes_of_policy:
            raise UserError(
                f"policy {self.source} observes {sizes_of_policy} (own state, history, axes), this "
                f"game has {sizes}; make its game with openjax.make(policy.settings.environment)"
            )
        if game.strategies > 1 and observation.strategy is None:
            raise UserError(
                f"policy {self.source} draws one of {game.strategies} members, but this game "
                "draws none; make its game with openjax.make(policy.settings.environment)"
            )
        return self.policy.act(self.parameters, observation)


def load_policy(
    name_or_path: str | Path = DEFAULT_POLICY,
    environment: Pursuit | None = None,
    policy: Policy | Network | None = None,
) -> LoadedPolicy:
    """Load a policy.

    Args:
      name_or_path: a name from `known_policies()` (`DEFAULT_POLICY` if none is given),
        a policy file (.npz), a run's directory (its best policy) or a checkpoint's
        directory inside a run, or `FILE.py:function`, see `own_controller`.
      environment, policy: those of one's own that a run was trained with
      (`openjax.train`), as its files hold numbers alone.

    Raises:
      UserError: nothing of that kind is there, or it's of another shape than its
      settings say.
    """
    path = Path(name_or_path)
    source = str(name_or_path)
    if environment is not None or policy is not None:
        return _load_own(open_run(path), source, environment, policy)
    # names before paths: a folder called "open" doesn't hide the shipped policy
    if source in METHODS:
        return _heuristic(source)
    if is_own_code(source):
        what = "function {}(observation) that gives actions (N, 4)"
        return own_controller(own_code("--policy", source, (), what), PursuitSettings(), source)
    if str(name_or_path) in shipped_policies():
        return _from_file(WEIGHTS / f"{name_or_path}.npz", source)
    if is_run(path):
        return _from_run(RunDirectory(path), source)
    if path.is_file():
        return _from_file(path, source)
    if is_checkpoint(path) and is_run(path.parent.parent):
        run = RunDirectory(path.parent.parent)
        return _build(run.read_settings(), load_arrays(path, policy_leaf), source)
    if path.exists():
        raise UserError(
            f"{path} is no policy; expected a .npz file, a run of openjax.train or one of its "
            "checkpoints"
        )
    hint = suggestion(source, known_policies())
    raise UserError(
        f"policy {source}: no such file or directory, nor shipped with the package; {hint}"
    )


def known_policies() -> list[str]:
    """Names that `load_policy` knows: heuristics and the policies inside the
    package.
    """
    return [*METHODS, *shipped_policies()]


def own_controller(
    function: Callable[[Observation], jax.Array], game: PursuitSettings, source: str
) -> LoadedPolicy:
    """A pure function from the `Observation` of one world to actions (N, 4) in -1..1 as
    a policy for this game.
    """
    nothing = PolicyParameters(actor={}, critic={}, predictor={})
    # which fits all games
    lengths = dict.fromkeys(("rollout_length", "restart_steps"), game.episode_length)
    settings = TrainSettings(environment=game, predictor=OwnController.predictor, **lengths)
    return LoadedPolicy(OwnController(function), nothing, settings, source)


def _heuristic(name):
    settings = TrainSettings()
    policy = Heuristic.for_environment(name, Pursuit(settings.environment))
    return LoadedPolicy(policy, policy.parameters(), settings, name)


def abstract_parameters(environment: Pursuit, policy: Policy) -> PolicyParameters:
    """Shapes and dtypes of the policy's parameters."""
    return jax.eval_shape(
        lambda key: policy.init(key, environment.reset(key)[0]), jax.random.key(0)
    )


def _from_file(path, source):
    leaves, settings, _ = load_policy_file(path)
    return _build(from_plain(TrainSettings, settings, f"{path}: "), leaves, source)


def _load_own(run, source, environment, policy):
    """The best policy of a run with parts of one's own."""
    settings = run.read_settings()
    parts = build(settings, environment, policy)
    abstract = abstract_parameters(parts.environment, parts.policy)
    parameters = fill(abstract, load_policy_file(run.policy)[0], source)
    return LoadedPolicy(parts.policy, parameters, settings, source, parts.environment)


def _from_run(run, source):
    if "policy" in run.read_facts().get("own_parts", ()):
        raise UserError(
            f"{source} was trained with a network of your own: load it in Python, by "
            "openjax.load_policy(run, environment, network)"
        )
    if run.policy.exists():
        return _from_file(run.policy, source)
    checkpoints = Checkpoints(run.checkpoints)
    if not checkpoints.any_finished():
        raise UserError(f"{run.path} holds no policy and no checkpoint yet")
    leaves, _ = checkpoints.load_best(policy_leaf, lambda text: None)
    return _build(run.read_settings(), leaves, source)


def _build(settings, leaves, source):
    game = settings.environment
    # learned evaders' networks aren't in a policy's file
    evaders = tuple(name for name in game.evaders if name in SCRIPTED) or PursuitSettings().evaders
    settings = dataclasses.replace(settings, environment=dataclasses.replace(game, evaders=evaders))
    if jax.default_backend() == "cpu":  # CPUs emulate bfloat16, slowly
        settings = dataclasses.replace(
            settings, network=dataclasses.replace(settings.network, compute_type="float32")
        )
    policy, abstract = _initial(settings.environment, settings.network, settings.predictor)
    if not any(name.startswith("critic/") for name in leaves):
        # Shipped without: flying needs no critic.
        abstract = abstract.replace(critic={})
    parameters = fill(abstract, leaves, source)
    if unknown := sorted(set(leaves) - set(named_leaves(abstract))):
        raise UserError(f"{source} holds {unknown[0]}, which the network of its settings lacks")
    return LoadedPolicy(policy, parameters, settings, source)


@functools.lru_cache(maxsize=8)
def _initial(game: PursuitSettings, network: NetworkSettings, predictor: PredictorSettings):
    """The networks of these settings and the kinds of their parameters, which take a
    second to trace.
    """
    environment = Pursuit(game)
    policy = make_policy(environment, network, predictor)
    return policy, abstract_parameters(environment, policy)
