"""A task for learners of other libraries: a tumbling drone is to be caught and held at a point.

Each learner sees what the drone does and commands thrust and body rates a hundred times a second.
What counts are the seconds, compilation included, until it holds the drone for `HOLDS` of an
episode.
"""

import time

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from openjax.pursuit import action_to_command, hover_action
from openjax.vehicle import hover_state, load_vehicle, make_drones_step, rotate

VEHICLE = load_vehicle()
HOVER = 0.5 * (float(hover_action(VEHICLE)[0]) + 1.0)
"""Share of the full thrust that holds it in the air."""
FREE = make_drones_step("rigid", contacts=False)
EPISODE = 300
"""Steps of 10 ms."""
HOLDS = 0.3
"""Share of an episode within .2 m and below .5 m/s. The controller by hand comes to .40: commands
turn a drone by half a turn a second at most.
"""
SIZE = 18
"""Numbers that a learner sees."""


def tumble(key):
    """A drone anywhere within .5 m of the goal, in any attitude, turning at some rad/s."""
    place, turn, rates = jax.random.split(key, 3)
    quaternion = jax.random.normal(turn, (4,))
    drone = hover_state(
        VEHICLE, jax.random.uniform(place, (3,), minval=-0.5, maxval=0.5),
        quaternion / jnp.linalg.norm(quaternion),
    )  # fmt: skip
    return drone.replace(body_rates=2.0 * jax.random.normal(rates, (3,)))


def axes_of(drone):
    """(3, 3) the body's axes in the world's, one a row."""
    return jax.vmap(lambda axis: rotate(drone.quaternion, axis))(jnp.eye(3))


def see(drone):
    axes = axes_of(drone)
    return jnp.concatenate([drone.position, axes.ravel(), drone.velocity, drone.body_rates / 10.0])


def recover(drone, action):
    """The drone a step later, its reward, and whether it is held at the goal."""
    command = action_to_command(jnp.clip(action, -1.0, 1.0))[None]
    team = jax.tree.map(lambda leaf: leaf[None], drone)
    team = FREE(VEHICLE, team, command, jnp.zeros((0, 2)), jnp.zeros(0, bool))
    drone = jax.tree.map(lambda leaf: leaf[0], team)
    distance = jnp.linalg.norm(drone.position)
    speed = jnp.linalg.norm(drone.velocity)
    reward = jnp.exp(-3.0 * distance) - 0.05 * speed - 0.01 * jnp.sum(drone.body_rates**2) / 10.0
    return drone, reward, (distance < 0.2) & (speed < 0.5)


def by_hand(drone, gains=(16.0, 9.0, 12.0)):
    """The action of a controller: gains of position, velocity and tilt, the best of some."""
    wanted = -gains[0] * drone.position - gains[1] * drone.velocity
    wanted += jnp.array([0.0, 0.0, VEHICLE.gravity])
    axes = axes_of(drone)
    turn = jnp.cross(axes[2], wanted)
    angle = jnp.arctan2(jnp.linalg.norm(turn), axes[2] @ wanted)
    rates = gains[2] * angle * (axes @ turn) / (jnp.linalg.norm(turn) + 1e-6)
    thrust = HOVER * jnp.maximum(axes[2] @ wanted, 0.0) / VEHICLE.gravity
    return jnp.array([2.0 * thrust - 1.0, rates[0] / jnp.pi, rates[1] / jnp.pi, 0.0])


def controller(worlds: int) -> dict:
    """What the controller by hand holds, without any learning."""

    def step(drone, _):
        drone, _, held = jax.vmap(lambda one: recover(one, by_hand(one)))(drone)
        return drone, held

    drones = jax.vmap(tumble)(jax.random.split(jax.random.key(1), worlds))
    held = jax.jit(lambda drones: jax.lax.scan(step, drones, None, length=EPISODE)[1])(drones)
    return {"held": float(jnp.mean(held))}


def brax_ppo(steps: int, worlds: int = 2048) -> dict:
    """Brax's PPO, with the network and the numbers of its own examples."""
    from brax.envs.base import Env, State
    from brax.training.agents.ppo import train as ppo

    # Brax 0.14.2 asks for a function that JAX 0.10 no longer has
    jax.device_put_replicated = lambda tree, devices: jax.tree.map(
        lambda leaf: jnp.stack([leaf] * len(devices)), tree
    )

    class Recovery(Env):
        observation_size = SIZE
        action_size = 4
        backend = "openjax"

        def reset(self, rng):
            drone = tumble(rng)
            zero = jnp.zeros(())
            return State(drone, see(drone), zero, zero, {"held": zero})

        def step(self, state, action):
            drone, reward, held = recover(state.pipeline_state, action)
            metrics = {**state.metrics, "held": held.astype(jnp.float32)}
            return state.replace(
                pipeline_state=drone, obs=see(drone), reward=reward, metrics=metrics
            )

    begin = time.perf_counter()
    curve = []

    def note(number, metrics):
        held = float(metrics["eval/episode_held"]) / EPISODE
        curve.append({"steps": int(number), "seconds": time.perf_counter() - begin, "held": held})

    ppo.train(
        Recovery(), num_timesteps=steps, episode_length=EPISODE, progress_fn=note, num_evals=20,
        num_eval_envs=min(128, worlds), num_envs=worlds, batch_size=worlds // 2, num_minibatches=32,
        unroll_length=10, seed=0, num_updates_per_batch=4, normalize_observations=True,
        learning_rate=3e-4, discounting=0.97,
    )  # fmt: skip
    return summary(curve)


class RecoveryEnv(gymnasium.Env):
    """The task for one learner that steps one drone."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (SIZE,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
    spec = gymnasium.envs.registration.EnvSpec("Recovery-v0", max_episode_steps=EPISODE)
    """By which rl-tools knows how long an episode is: without it its program isn't compiled."""

    def __init__(self):
        self._tumble = jax.jit(tumble)
        self._recover = jax.jit(lambda drone, action: (*recover(drone, action),))
        self._see = jax.jit(see)
        self.held: list[float] = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._drone = self._tumble(jax.random.key(int(self.np_random.integers(2**31))))
        self._step = 0
        self.held.append(0.0)
        return np.asarray(self._see(self._drone)), {}

    def step(self, action):
        self._drone, reward, held = self._recover(self._drone, jnp.asarray(action, jnp.float32))
        self._step += 1
        self.held[-1] += float(held) / EPISODE
        seen = np.asarray(self._see(self._drone))
        return seen, float(reward), False, self._step >= EPISODE, {}


def rl_tools_sac(steps: int) -> dict:
    """rl-tools' SAC, by its Python interface; what it does while it learns counts."""
    from rltools import SAC

    # a single drone is stepped sooner there than on a GPU
    jax.config.update("jax_default_device", jax.devices("cpu")[0])
    environments = []

    def make():
        environments.append(RecoveryEnv())
        environments[-1].reset(seed=0)
        return environments[-1]

    begin = time.perf_counter()
    state = SAC(make, STEP_LIMIT=steps, enable_evaluation=False).State(0)
    curve = []
    for number in range(steps):
        if state.step():
            break
        if number % (10 * EPISODE) == 0:
            held = max(float(np.mean(one.held[-10:])) for one in environments)
            curve.append({"steps": number, "seconds": time.perf_counter() - begin, "held": held})
            if held >= HOLDS:
                break
    return summary(curve)


def summary(curve: list[dict]) -> dict:
    """The curve, and when it first holds (None: never)."""
    good = [point["seconds"] for point in curve if point["held"] >= HOLDS]
    return {"seconds_until_held": good[0] if good else None, "curve": curve}
