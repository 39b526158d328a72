"""The simulator itself as a world: nominal, or with effects; the rate loop at 500 Hz."""

import functools

import jax
import numpy as np

from experiments.flying.worlds.world import Poses
from openjax.pursuit import Task
from openjax.vehicle import DroneState, load_vehicle, make_drones_step


@functools.cache
def _compiled(physics, effects):
    vehicle = load_vehicle()
    step = make_drones_step(physics, substeps=5, effects=effects)
    fly = jax.jit(jax.vmap(functools.partial(step, vehicle), in_axes=(0, 0, 0, 0, None)))
    reset = jax.jit(jax.vmap(functools.partial(step.reset, vehicle)))
    return fly, reset, jax.jit(jax.vmap(step.seen, in_axes=(0, None)))


class SimulatorWorld:
    """Vehicles of `openjax.vehicle`, all with the same effects.

    Args:
      drones: (W, N, ...) at the start.
      tasks: (W, ...), for their pillars.
      effects: {effect: {parameter: value}}.
      physics: see `openjax.vehicle.make_drones_step`.
    """

    def __init__(self, drones: DroneState, tasks: Task, effects: dict | None = None, physics: str = "rigid"):
        self.effects = effects or {}
        self._fly, reset, self._seen = _compiled(physics, tuple(sorted(self.effects)))
        keys = jax.random.split(jax.random.key(1), drones.position.shape[0])
        self.drones = reset(drones.replace(effect_memory=()), keys)
        self.pillars = (tasks.pillar_position, tasks.pillar_active)

    def poses(self) -> Poses:
        """Where the vehicles are."""
        return _plain(self.drones)

    def measure(self) -> Poses:
        """Where the effects on the sensors show them."""
        return _plain(self._seen(self.drones, self.effects))

    def fly(self, command, max_speed=None) -> None:
        """One tick."""
        self.drones = self._fly(self.drones, command.astype(np.float32), *self.pillars, self.effects)
        if max_speed is not None:
            speed = np.linalg.norm(self.drones.velocity, axis=-1, keepdims=True) + 1e-12
            velocity = self.drones.velocity * np.minimum(1.0, max_speed / speed)
            self.drones = self.drones.replace(velocity=velocity)


def _plain(drones) -> Poses:
    return {name: np.asarray(getattr(drones, name)) for name in ("position", "quaternion", "velocity")}
