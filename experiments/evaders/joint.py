"""One population, trained jointly from weights that ship: `python -m
experiments.evaders.joint OUT [--codes ...]`.

The team's network observes a code that is drawn every 0.4 s, and each pursuer one of its
own; an average of its weights, towards which it is pulled, is what is kept. It learns
against evaders that learn, of which one begins again from nothing every so often, and
against their earlier selves; at last against evaders that plan.
"""

import argparse
import dataclasses
import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax.flatten_util import ravel_pytree

import openjax
from openjax.learning.evader_learning import EvaderLearning
from openjax.learning.learners.evasion import EvaderLearner
from openjax.learning.learners.mappo import WATCHED, Mappo, MappoState, every_nth, loss
from openjax.learning.train_state import TrainState
from openjax.policy import make_policy
from openjax.policy.growth import in_larger_game
from openjax.pursuit import Pursuit
from openjax.pursuit.teams import team_mean
from openjax.store.mixed_policies import member
from openjax.store.policies import load_policy
from openjax.store.policy_files import save_policy_file

END = 0.98
"""Share of the run after which the average of weights takes their place."""


@dataclass(frozen=True)
class Restarting(EvaderLearner):
    """Evaders that learn, of which one after the other begins again from nothing."""

    every: int = 60
    """Updates between two such."""
    chosen: int = 3
    """The first so many do, in turn: a whole life is `every` times as long as these are
    many.
    """

    def learn(self, state, parameters, experience, key):
        """After a rollout; then one of the evaders may be a fresh one."""
        state, parameters, metrics = super().learn(state, parameters, experience, key)
        fresh = self.learning.start(jax.random.fold_in(key, 7))
        is_due = state.update % self.every == 0
        which = (state.update // self.every) % self.chosen
        number = state.log_std.shape[0]
        is_new = is_due & (jnp.arange(number) == which)

        def renew(new, old):
            return jnp.where(is_new.reshape(-1, *[1] * (old.ndim - 1)), new, old)

        names = ("actor", "critic", "log_std")
        changes = {
            name: jax.tree.map(renew, getattr(fresh, name), getattr(state, name)) for name in names
        }
        # the moments of Adam begin again; its count goes on, as the rate falls by it
        changes["optimiser"] = jax.tree.map(
            lambda new, old: old if jnp.issubdtype(old.dtype, jnp.integer) else renew(new, old),
            fresh.optimiser,
            state.optimiser,
        )
        return state.replace(**changes), parameters, metrics


@struct.dataclass
class Anchored:
    """MAPPO's state, and the average of the actor's weights."""

    mappo: MappoState
    average: Any


@dataclass(frozen=True)
class AnchoredMappo(Mappo):
    """MAPPO with a divergence from the policy of averaged weights in its loss (EMAgnet,
    arXiv 2606.23995; NashPG, arXiv 2510.18183).
    """

    weight: float = 0.05
    decay: float = 0.99
    """Share of the average that stays in an update."""
    anchor: Any = None
    """The average, while an update is made."""

    def start(self, parameters, key):
        """The average begins as the first weights."""
        return Anchored(super().start(parameters, key), parameters.actor)

    def learn(self, state, parameters, experience, key):
        """All epochs, then the average goes on."""
        anchored = dataclasses.replace(self, anchor=state.average)
        mappo, parameters, metrics = Mappo.learn(anchored, state.mappo, parameters, experience, key)
        # before the actor learns there is nothing to average
        average = jax.tree.map(
            lambda old, new: self.decay * old + (1.0 - self.decay) * new,
            state.average,
            parameters.actor,
        )
        # at the end it is what flies
        is_end = experience.progress > END
        actor = jax.tree.map(
            lambda mean, own: jnp.where(is_end, mean, own), average, parameters.actor
        )
        return Anchored(mappo, average), parameters.replace(actor=actor), metrics

    def _epochs(self, networks, batch, experience, key):
        """As MAPPO's, with the divergence."""
        settings = self.settings
        actor, critic = networks
        change = settings.clip_epsilon_end - settings.clip_epsilon
        clip = settings.clip_epsilon + change * experience.progress
        actor_vector, to_actor = ravel_pytree(actor.parameters)
        critic_vector, to_critic = ravel_pytree(critic.parameters)
        anchor = self.anchor

        def gradient_step(carry, step):
            actor, critic = carry
            index, first = step
            part = jax.tree.map(
                lambda x: every_nth(x[index], first, settings.step_subsampling), batch
            )
            goal, _ = self.policy.distribution(anchor, part.observation, part.predicted)

            def part_loss(actor, critic):
                parameters = (to_actor(actor), to_critic(critic))
                value, watch = loss(settings, self.policy, parameters, part, clip)
                mean, log_std = self.policy.distribution(
                    parameters[0], part.observation, part.predicted
                )
                score = (mean - jax.lax.stop_gradient(goal)) * jnp.exp(
                    -jax.lax.stop_gradient(log_std)
                )
                distance = 0.5 * jnp.sum(score**2, axis=-1)
                return value + self.weight * team_mean(part.observation.active, distance), watch

            gradient = jax.grad(part_loss, argnums=(0, 1), has_aux=True)(
                actor.parameters, critic.parameters
            )
            (actor_gradient, critic_gradient), watch = experience.mean(gradient)
            watch |= {"actor_gradient": jnp.linalg.norm(actor_gradient)}
            actor = actor.update(self.optimisers[0], actor_gradient, kl=watch["kl"])
            critic = critic.update(self.optimisers[1], critic_gradient)
            return (actor, critic), jnp.stack([watch[name] for name in WATCHED])

        start = (actor.replace(parameters=actor_vector), critic.replace(parameters=critic_vector))
        (actor, critic), measures = jax.lax.scan(gradient_step, start, self._order(key))
        actor = TrainState(to_actor(actor.parameters), actor.optimiser)
        critic = TrainState(to_critic(critic.parameters), critic.optimiser)
        metrics = dict(zip(WATCHED, jnp.mean(measures, axis=0), strict=True))
        return (actor, critic), metrics


def recipe(options):
    """The settings of the run: those of `teams`, for three, with numbers nearer to the
    usual game's.
    """
    learned = ["learned"] * 8
    return openjax.preset(
        "teams",
        environment=dict(
            num_pursuers=3,
            team_sizes=(),
            evader_speeds=(1.0, 2.0),
            capture_radii=(0.2, 0.4),
            arena_radii=(0.8, 1.1),
            fall_outs=0.0,
            evaders=("field", "greedy", "wall_runner", "slow_hugger", *learned),
            team_code=options.team_code,
            own_code=options.own_code,
            strategy_seconds=0.4 if options.team_code + options.own_code else 0.0,
        ),
        mappo=dict(actor_start=0.04, learning_rate=5e-4, penalty_start=1.0),
        evader_learning=dict(past=3, epochs=4),
        worst_plans=dict(
            worlds=512, team_plans=48, crash=8.0, breach=2.0, hold_unseen=0.02, plans=32
        ),
        analytic=dict(
            updates=options.last_updates,
            look_every=50,
            worlds=256,
            breach=2.0,
            speed=0.6,
            hold=0.01,
        ),
        evaders_start=0.0,
        evaders_ramp=0.02,
        num_envs=options.worlds,
        total_steps=options.steps,
        seed=options.seed,
        **({} if not options.tiny else TINY),
    )


TINY = dict(validation_episodes=4, rollout_length=80)


def grown(policy: str, settings, path: Path) -> str:
    """A file of a policy's first member in the game of the run, whose codes' weights are
    small random ones: from zeros they would have no gradient.
    """
    start = member(load_policy(policy), 0)
    if settings.environment.team_code + settings.environment.own_code == 0:
        return policy
    game = settings.environment
    old = start.settings.environment
    parameters = in_larger_game(start.parameters, settings.predictor, old, game)
    kernel = parameters.actor["params"]["encoder"]["self_1"]["kernel"]
    codes = game.team_code + game.own_code
    first = game.self_size - codes  # no history behind them
    # a fifth of what other inputs have
    scale = 0.2 * jnp.std(kernel[:first])
    noise = scale * jax.random.normal(jax.random.key(1), (codes, kernel.shape[1]))
    kernel = kernel.at[first : first + codes].set(noise)
    params = dict(parameters.actor["params"])
    encoder = dict(params["encoder"])
    encoder["self_1"] = {**encoder["self_1"], "kernel": kernel}
    parameters = parameters.replace(actor={"params": {**params, "encoder": encoder}})
    as_trained = dataclasses.replace(start.settings, environment=game)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_policy_file(path, parameters, as_trained, {"grown from": policy}, storage="float32")
    return str(path)


def main():
    """Train."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--policy", default="teams")
    parser.add_argument("--team_code", type=int, default=2)
    parser.add_argument("--own_code", type=int, default=2)
    parser.add_argument("--weight", type=float, default=0.05, help="of the divergence")
    parser.add_argument("--restart_every", type=int, default=60)
    parser.add_argument("--last_updates", type=int, default=100)
    parser.add_argument("--worlds", type=int, default=5120)
    parser.add_argument("--steps", type=int, default=280_000_000)
    parser.add_argument("--minutes", type=float)
    parser.add_argument("--seed", type=int, default=91)
    parser.add_argument("--tiny", action="store_true")
    options = parser.parse_args()
    settings = recipe(options)
    start = grown(options.policy, settings, options.out.with_name(options.out.name + "_start.npz"))
    environment = Pursuit(settings.environment)
    policy = make_policy(environment, settings.network, settings.predictor)
    updates = settings.total_updates
    learning = EvaderLearning(settings.evader_learning, environment, updates)
    learners = {
        "evaders": Restarting(learning, options.restart_every),
        "policy": AnchoredMappo(settings.mappo, policy, updates, options.weight),
    }
    train = functools.partial(openjax.train, settings, options.out, overwrite=True)
    train(minutes=options.minutes, start_from=start, learners=learners)


if __name__ == "__main__":
    main()
