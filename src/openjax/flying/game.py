"""The game around vehicles that fly somewhere else: what the pursuers observe, what the
policy answers, where the evader goes.

The whole tick (the game's step, the observation, predictor and actor) is one function,
compiled ahead.
"""

import dataclasses
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from openjax.flying.controller import Airframe, Pose, airframe_of
from openjax.flying.real_time import compile_in_line
from openjax.pursuit import Pursuit, Task
from openjax.pursuit.teams import draw_strategies


class Play(NamedTuple):
    """The result of one tick; NumPy."""

    action: np.ndarray  # (N, 4) in -1..1
    evader_position: np.ndarray  # (3,) m
    evader_velocity: np.ndarray  # (3,) m/s
    captured: bool
    over: bool
    breaches: np.ndarray  # (N,)
    crashed: np.ndarray  # (N,)
    draws: tuple[float, ...] = ()
    """At the start of an episode: from 0 to 1, by which the team chooses the strategies that it
    flies one after another (`openjax.pursuit.teams.strategy_of`); empty where it has one.
    """


def game_functions(policy):
    """The game's settings and airframe, and its two steps as pure functions of arrays, to compile
    or to map.

    first(task, poses (N, 13), seed ()) -> state, action (N, 4): an episode begins with the pursuers
    at `poses`; the seed draws which strategies a team flies that draws them. tick(state, action,
    poses, evader (3,), evader_measured ()) -> state, action, *fields of `Play` but the first: one
    control step later they are at `poses`.
    """
    # what shapes a training world, but not a measured one: the vehicles drawn for it, the clamp
    settings = dataclasses.replace(policy.settings.environment, vehicles=(), speed_limit="none")
    environment = Pursuit(settings)

    def drones_of(poses):
        position, quaternion, velocity, body_rates = jnp.split(poses, (3, 7, 10), axis=1)
        quaternion = quaternion / jnp.linalg.norm(quaternion, axis=1, keepdims=True)
        return {
            "position": position,
            "quaternion": quaternion,
            "velocity": velocity,
            "body_rates": body_rates,
        }

    def first(task: Task, poses, seed=0):
        drones = drones_of(poses)
        _, state = environment.reset_to(
            jax.random.key(0), task.replace(pursuer_position=drones["position"])
        )
        state = state.replace(
            drones=state.drones.replace(**drones),
            strategies=draw_strategies(settings, jax.random.key(seed)),
        )
        return state, policy(environment.observe(state))

    def tick(state, action, poses, evader, evader_measured):
        # a real evader is where it is, not where the rule would have put it
        place = jnp.where(evader_measured, evader, state.evader_position)
        state = state.replace(evader_position=place)
        drones = state.drones.replace(**drones_of(poses))
        observation, state, _, terminated, truncated, info = environment.follow(
            state, action, drones
        )
        return (
            state,
            policy(observation),
            state.evader_position,
            state.evader_velocity,
            jnp.any(info.captured),
            terminated | truncated,
            info.breaches.total,
            info.crashed,
        )

    return settings, airframe_of(environment.vehicle), first, tick


class Game:
    """A policy's game with measured pursuers.

    Args:
      policy: what `openjax.load_policy` gives; only its settings and its call are used.
      task: pursuers' starts, evader's start, pillars.
      airframe: what flies; that of the policy's vehicle, if it isn't given.
    """

    def __init__(self, policy, task: Task, airframe: Airframe | None = None):
        self.task = jax.tree.map(np.asarray, task)
        self.settings, own_airframe, first, tick = game_functions(policy)
        self.airframe = airframe or own_airframe
        # apart, so that nothing is divided by a distance of zero
        poses = [
            Pose(0.0, (0.3 * i, 0.0, 0.5), (0.0,) * 3, (1.0, 0.0, 0.0, 0.0))
            for i in range(self.settings.num_pursuers)
        ]
        example = pose_array(poses)
        kinds = jax.eval_shape(first, task, example)
        nothing = jax.tree.map(lambda kind: jnp.zeros(kind.shape, kind.dtype), kinds)
        self._flat, unflatten = ravel_pytree(nothing)
        nowhere = np.zeros(3, np.float32)
        not_measured = np.zeros((), bool)

        # the state as one array: as a tree of some thirty the call takes half as long again
        def begin(poses, seed):
            state, action = first(task, poses, seed)
            none = np.zeros(0, np.float32)
            draws = none if state.strategies is None else state.strategies
            return ravel_pytree((state, action))[0], action, draws

        def move(flat, poses, evader, evader_measured):
            state, action = unflatten(flat)
            state, *results = tick(state, action, poses, evader, evader_measured)
            return ravel_pytree((state, results[0]))[0], results

        # whoever knew what a team draws could wait for it: other draws in each episode
        self._draws = np.random.default_rng()
        self._first = compile_in_line(jax.jit(begin).lower(example, np.uint32(0)))
        program = jax.jit(move).lower(self._flat, example, nowhere, not_measured)
        self._tick = compile_in_line(program)
        # the first calls take tens of milliseconds: not in flight
        self.start(poses)
        self.step(poses)

    def start(self, poses: list[Pose]) -> Play:
        """Begin an episode with the pursuers at `poses`."""
        seed = self._draws.integers(2**32, dtype=np.uint32)
        self._flat, action, draws = self._first(pose_array(poses), seed)
        n = self.settings.num_pursuers
        return Play(
            action=np.asarray(action),
            evader_position=np.asarray(self.task.evader_position),
            evader_velocity=np.zeros(3),
            captured=False,
            over=False,
            breaches=np.zeros(n),
            crashed=np.zeros(n, bool),
            draws=tuple(round(float(draw), 4) for draw in np.asarray(draws)),
        )

    def step(self, poses: list[Pose], evader: np.ndarray | None = None) -> Play:
        """One control step later the pursuers are at `poses`, the evader, if it is
        measured, at (3,) `evader`.
        """
        is_measured = np.asarray(evader is not None)
        place = np.zeros(3, np.float32) if evader is None else np.asarray(evader, np.float32)
        self._flat, results = self._tick(self._flat, pose_array(poses), place, is_measured)
        action, position, velocity, captured, over, breaches, crashed = map(np.asarray, results)
        return Play(action, position, velocity, bool(captured), bool(over), breaches, crashed)


def pose_array(poses) -> np.ndarray:
    """(N, 13) position, quaternion, velocity, body rates."""
    rows = [(*p.position, *p.quaternion, *p.velocity, *p.body_rates) for p in poses]
    return np.array(rows, np.float32)
