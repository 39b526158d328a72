"""Fine-tuning a policy to one diagnosed vehicle, by programs that are compiled before the diagnosis is known."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

from openjax.learning.evaluation import Evaluation, make_evaluate
from openjax.learning.settings import TrainSettings
from openjax.learning.training_step import TrainCarry, build, init_carry, make_training_step
from openjax.policy import Policy, PolicyParameters
from openjax.policy.growth import with_longer_history
from openjax.pursuit import Pursuit, Task
from openjax.ranges import Interval, check_intervals
from openjax.vehicle import load_vehicle
from openjax.vehicle.family import adapted_family, family_bounds

RATE_LOOP = 0.002
"""Period of a Crazyflie's rate loop (s)."""
HISTORY = 12
"""Frames of its own flight that an adapted policy sees at least: with late commands and slow motors one isn't enough."""


@dataclass(frozen=True)
class AdaptSettings:
    """How a policy is fine-tuned."""

    num_envs: Annotated[int | None, Interval("[1, 16777216]")] = None
    """Worlds; by default 5,120 on an accelerator, 160 on a CPU, which is enough to see it work."""
    updates: Annotated[int, Interval("[1, 1000000]")] = 40
    """Training steps of the policy, after ..."""
    warm_up: Annotated[int, Interval("[0, 1000000]")] = 20
    """... those in which only the critic learns: shipped policies come without one, and a wrong one spoils the policy."""
    look_every: Annotated[int, Interval("[1, 1000000]")] = 8
    """Steps of the policy between looks at what it has become; the best of all looks is kept."""
    learning_rate: Annotated[float, Interval("(0, 1]")] = 6e-4
    """Adam step size at the start."""
    clip_epsilon: Annotated[float, Interval("(0, 10]")] = 0.1
    """Clip range of the probability ratio."""

    def __post_init__(self):
        check_intervals(self, "training.")


def adapting_settings(trained: TrainSettings, settings: AdaptSettings) -> TrainSettings:
    """The training's settings for fine-tuning: penalties in full, small steps, vehicles of every kind of effect."""
    game = trained.environment
    num_envs = settings.num_envs or (160 if jax.default_backend() == "cpu" else 5120)
    num_envs = max(num_envs // trained.world_unit, 1) * trained.world_unit
    minibatches = max(n for n in range(1, trained.mappo.minibatches + 1) if num_envs % n == 0)
    return dataclasses.replace(
        trained,
        # as vehicles fly: no clamp, the rate loop at 500 Hz, solid pillars; whatever the policy was trained in
        environment=dataclasses.replace(
            game,
            vehicles=adapted_family({}, {}),
            rare_vehicles=0.0,
            observe_history=max(game.observe_history, HISTORY),
            speed_limit="none",
            physics="stops",
            substeps=max(game.substeps, round(game.time_step / RATE_LOOP)),
        ),
        mappo=dataclasses.replace(
            trained.mappo,
            learning_rate=settings.learning_rate,
            clip_epsilon=settings.clip_epsilon,
            clip_epsilon_end=settings.clip_epsilon,
            penalty_start=1.0,
            # the optimiser learns the gradients' size meanwhile; with moments of zero its first steps would be ten times as long
            critic_lambda=1.0,
            actor_start=settings.warm_up / (settings.warm_up + settings.updates),
            minibatches=minibatches,
        ),
        # uniform tasks: by them the best step is chosen, and with tasks from the archive it came out no better
        generator=dataclasses.replace(trained.generator, expansion=0.0),
        vehicles_start=0.0,
        vehicles_ramp=0.0,
        num_envs=num_envs,
        total_steps=(settings.updates + settings.warm_up) * num_envs * trained.rollout_length,
    )


def starting_parameters(
    parameters: PolicyParameters, trained: TrainSettings, settings: TrainSettings
) -> PolicyParameters:
    """The policy trained with `trained` as it begins in `settings`, without its critic; it acts as before."""
    grown = with_longer_history(
        parameters.replace(critic={}), settings.predictor, trained.environment, settings.environment
    )
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), grown)


@dataclass(frozen=True)
class Adaptation:
    """The compiled programs: the training step and the evaluation, both for vehicles whose bounds are an argument."""

    settings: TrainSettings
    policy: Policy
    start: Callable[[jax.Array, jax.Array], TrainCarry]
    """(key, bounds) -> carry."""
    step: Callable[[TrainCarry, jax.Array], tuple[TrainCarry, dict[str, jax.Array]]]
    """(carry, bounds) -> carry, metrics; the carry is donated."""
    evaluate: Callable[[PolicyParameters, Task, jax.Array, jax.Array], Evaluation]
    """(parameters, tasks, key, bounds) -> one episode per task."""


def make_adaptation(settings: TrainSettings) -> Adaptation:
    """The programs for `adapting_settings`, not compiled yet."""

    vehicle = load_vehicle()

    def environment(bounds):
        return Pursuit(settings.environment, vehicle, vehicle_bounds=bounds)

    policy = build(settings).policy
    return Adaptation(
        settings=settings,
        policy=policy,
        start=jax.jit(lambda key, bounds: init_carry(settings, key, environment(bounds))),
        step=jax.jit(
            # the predictor stays as it is: the evader flies no vehicle
            lambda carry, bounds: make_training_step(settings, environment(bounds), train_predictor=False)(
                carry
            ),
            donate_argnums=0,
        ),
        evaluate=jax.jit(
            lambda parameters, tasks, key, bounds: make_evaluate(environment(bounds), policy)(
                parameters, tasks, key
            )
        ),
    )


@dataclass(frozen=True)
class Tuned:
    """What fine-tuning led to."""

    parameters: PolicyParameters
    """The best of those looked at, the first ones among them; without a critic."""
    update: int
    """After which training step they were found; 0: they are the first ones."""
    history: list[dict[str, float]]
    """Metrics of each training step."""
    looks: dict[int, float]
    """{training step: mean score}."""


def fine_tune(
    adaptation: Adaptation,
    parameters: PolicyParameters,
    bounds: jax.Array,
    training: AdaptSettings,
    key: jax.Array,
    score: Callable[[PolicyParameters], np.ndarray],
    tell: Callable[[int, dict[str, jax.Array]], Any] = lambda update, metrics: None,
) -> Tuned:
    """Train `parameters` (critic left aside) on vehicles within `bounds` (R, 4), and keep the best on the way.

    `score` gives the scores of episodes (B,), of the same tasks and vehicles each time; what isn't clearly better than the
    first parameters, by the differences of single episodes, isn't kept. `tell` hears of every training step.
    """
    bounds = jnp.asarray(bounds)
    carry = adaptation.start(key, bounds)
    learnt = carry.policy.replace(actor=parameters.actor, predictor=parameters.predictor)
    carry, history = carry.with_policy(jax.tree.map(jnp.copy, learnt)), []
    first = np.asarray(score(parameters.replace(critic={})))
    best, looks = (parameters.replace(critic={}), 0), {0: float(first.mean())}
    for update in range(1, adaptation.settings.total_updates + 1):
        carry, metrics = adaptation.step(carry, bounds)
        history.append(metrics)
        tell(update, metrics)
        trained = update - training.warm_up
        if trained > 0 and (
            trained % training.look_every == 0 or update == adaptation.settings.total_updates
        ):
            now = jax.tree.map(jnp.copy, carry.policy.replace(critic={}))
            scores = np.asarray(score(now))
            looks[update] = float(scores.mean())
            if looks[update] > looks[best[1]] and clearly_better(first, scores):
                best = now, update
    history = [{name: float(value) for name, value in row.items()} for row in jax.device_get(history)]
    return Tuned(*best, history, looks)


def clearly_better(before: np.ndarray, after: np.ndarray, errors: float = 2.0) -> bool:
    """Whether the scores (B,) of the same episodes rose by more than so many standard errors of their differences."""
    gain = np.asarray(after, float) - np.asarray(before, float)
    return bool(gain.mean() > errors * gain.std() / np.sqrt(len(gain)))


def bounds_of(values, intervals) -> jax.Array:
    """(R, 4) bounds of the family of a diagnosed vehicle; see `adapted_family`."""
    return jnp.asarray(family_bounds(adapted_family(values, intervals)))
