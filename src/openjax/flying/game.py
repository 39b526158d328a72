"""The game around vehicles that fly somewhere else: what the pursuers observe, what the policy answers, where the
evader goes.

The whole tick (the game's step, the observation, predictor and actor) is one function, compiled ahead.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from openjax.flying.controller import Pose
from openjax.pursuit import Pursuit, Task
from openjax.pursuit.environment import THRUST_LIMIT
from openjax.vehicle import hover_state

__all__ = ["THRUST_LIMIT", "Game", "Play"]

FIELDS = (("position", 3), ("quaternion", 4), ("velocity", 3), ("body_rates", 3))


class Play(NamedTuple):
    """What came of one tick; NumPy."""

    action: np.ndarray  # (N, 4) in -1..1
    evader_position: np.ndarray  # (3,) m
    evader_velocity: np.ndarray  # (3,) m/s
    captured: bool
    over: bool
    breaches: np.ndarray  # (N,)
    crashed: np.ndarray  # (N,)


class Game:
    """A policy's game with measured pursuers.

    Args:
        policy: what `openjax.load_policy` gives; only its settings and its call are used.
        task: pursuers' starts, evader's start, pillars.
    """

    def __init__(self, policy, task: Task):
        # what shapes a training world, but not a measured one: the vehicles drawn for it, the clamp
        settings = dataclasses.replace(policy.settings.environment, vehicles=(), speed_limit="none")
        self.settings, self.task = settings, task
        environment = Pursuit(settings)
        self.hover_thrust = float(
            environment.vehicle.mass
            * environment.vehicle.gravity
            / (4 * environment.vehicle.thrust_constant * environment.vehicle.max_rotor_speed**2)
        )

        def drones_of(poses):
            drones, start = {}, 0
            for name, size in FIELDS:
                drones[name] = poses[:, start : start + size]
                start += size
            drones["quaternion"] = drones["quaternion"] / jnp.linalg.norm(
                drones["quaternion"], axis=1, keepdims=True
            )
            return drones

        def first(poses):
            drones = drones_of(poses)
            _, state = environment.reset_to(
                jax.random.key(0), task.replace(pursuer_position=drones["position"])
            )
            nominal = jax.vmap(lambda p: hover_state(environment.vehicle, p))(drones["position"])
            state = state.replace(drones=state.drones.replace(rotor_speed=nominal.rotor_speed, **drones))
            return state, policy(environment.observe(state)), state.evader_position

        def tick(state, action, poses, evader, evader_measured):
            # a real evader is where it is, not where the rule would have put it
            state = state.replace(evader_position=jnp.where(evader_measured, evader, state.evader_position))
            drones = state.drones.replace(**drones_of(poses))
            observation, state, _, terminated, truncated, info = environment.follow(state, action, drones)
            action = policy(observation)
            return (
                state,
                action,
                state.evader_position,
                state.evader_velocity,
                jnp.any(info.captured),
                terminated | truncated,
                info.breaches.total,
                info.crashed,
            )

        example = np.zeros((settings.num_pursuers, sum(size for _, size in FIELDS)), np.float32)
        example[:, 3] = 1.0
        self._first = jax.jit(first).lower(example).compile()
        state, action, _ = jax.eval_shape(first, example)
        self._tick = (
            jax.jit(tick).lower(state, action, example, np.zeros(3, np.float32), np.zeros((), bool)).compile()
        )
        self._state, self._action = None, None

    def start(self, poses: list[Pose]) -> Play:
        """Begin an episode with the pursuers at `poses`."""
        self._state, action, evader = self._first(_array(poses))
        self._action = action
        n = self.settings.num_pursuers
        return Play(
            np.asarray(action), np.asarray(evader), np.zeros(3), False, False, np.zeros(n), np.zeros(n, bool)
        )

    def step(self, poses: list[Pose], evader: np.ndarray | None = None) -> Play:
        """One control step later the pursuers are at `poses`, the evader, if it is measured, at (3,) `evader`."""
        measured = np.asarray(evader is not None)
        place = np.zeros(3, np.float32) if evader is None else np.asarray(evader, np.float32)
        self._state, self._action, *rest = self._tick(
            self._state, self._action, _array(poses), place, measured
        )
        action, position, velocity, captured, over, breaches, crashed = map(np.asarray, (self._action, *rest))
        return Play(action, position, velocity, bool(captured), bool(over), breaches, crashed)


def _array(poses) -> np.ndarray:
    return np.array([[x for name, _ in FIELDS for x in getattr(p, name)] for p in poses], np.float32)
