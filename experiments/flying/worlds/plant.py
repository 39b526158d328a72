"""The exam's plant as a world: vehicles that take a command every 10 ms; 1 kHz inside,
no code of the simulator.

A game needs the next state before it knows the next command, a speed limit after each
tick, solid things and the wakes of a whole team: `diagnosis.plant.Flight` flies all of
it, one tick at a time.
"""

from dataclasses import dataclass

import numpy as np

from experiments.diagnosis import injection, plant, sensors, vehicle
from experiments.flying.worlds.game import Poses, per_world
from openjax.pursuit import Task
from openjax.vehicle import DroneState

RADIUS = 0.05  # m, the solid sphere of a drone
PILLAR_RADIUS, PILLAR_HEIGHT = 0.1, 1.2  # m
FORTUNE = 19  # of this room's random numbers; the exam's cases have others


def rng_of(seed: int, number: int, *more: int) -> np.random.Generator:
    """The random numbers of a vehicle; `more` tells its sensors, episodes and causes
    apart.
    """
    return np.random.default_rng(np.random.SeedSequence([FORTUNE, seed, number, *more]))


def sensors_of(seed: int, number: int) -> dict:
    """Sensors and air of a vehicle: light turbulence, white noise, every channel logged
    at 100 Hz.
    """
    sensors_drawn = sensors.draw(rng_of(seed, number, 1), "white", "psgacmv", "light")
    return sensors_drawn | {"rate": 100, "pose_rate": 100, "dropped": 0.0}


def air_of(drawn: dict, seed: int, number: int, ticks: int, worlds: range, team: int) -> dict:
    """Air of the teams of `worlds`, each with its own gusts, noise and battery; bodies
    last.
    """
    bodies = []
    for world in worlds:
        rng = rng_of(seed, number, 3, world)
        voltage = drawn["voltage"] + rng.uniform(-0.15, 0.1)
        for _ in range(team):
            bodies.append(sensors.draw_air(rng, drawn, ticks, voltage + rng.uniform(-0.02, 0.02)))
    return sensors.stack(bodies)


@dataclass
class Solids:
    """What can't be flown through: floor, pillars, and the other bodies of the same
    world.

    pillar (2, P, B) m and active (P, B) are those of each body's world; bodies of a
    world are neighbours in the last axis, `team` of them. Impacts are inelastic and
    without friction, as in `openjax.vehicle`.
    """

    pillar: np.ndarray
    active: np.ndarray
    team: int

    def stop(self, position, velocity):
        """Push bodies (3, B) out of what they touch, and take the approaching part of
        their velocity, in place.
        """
        low = position[2] < RADIUS
        if low.any():
            position[2, low] = RADIUS
            velocity[2, low] = np.maximum(velocity[2, low], 0.0)
        away = position[:2, None] - self.pillar
        distance = np.sqrt((away * away).sum(axis=0)) + 1e-12
        gap = distance - PILLAR_RADIUS - RADIUS
        hit = self.active & (gap < 0.0) & (position[2] < PILLAR_HEIGHT)
        for k, i in zip(*np.nonzero(hit), strict=True):
            normal = away[:, k, i] / distance[k, i]
            position[:2, i] -= gap[k, i] * normal
            velocity[:2, i] -= min(normal @ velocity[:2, i], 0.0) * normal
        for shift in range(1, self.team):
            # each body and the one `shift` further in its world; pairs come once
            worlds = position.reshape(3, -1, self.team)
            between = worlds[:, :, shift:] - worlds[:, :, : self.team - shift]
            apart = np.sqrt((between * between).sum(axis=0))
            for w, j in zip(*np.nonzero(apart < 2 * RADIUS), strict=True):
                one = w * self.team + j
                other = w * self.team + j + shift
                normal = between[:, w, j] / max(apart[w, j], 1e-9)
                closing = min(normal @ (velocity[:, other] - velocity[:, one]), 0.0)
                half = 0.5 * (2 * RADIUS - apart[w, j])
                for body, sign in ((one, -1.0), (other, 1.0)):
                    position[:, body] += sign * half * normal
                    velocity[:, body] -= sign * 0.5 * closing * normal


class PlantWorld:
    """Nominal vehicles in the exam's plant, each with its own noise and all with the
    same cause, or none.

    Args:
      drones: (W, N, ...) at the start.
      tasks: (W, ...), for their pillars.
      ticks: control steps to be flown at most.
      seed, number: of the vehicle: its sensors and cause.
      cause: of `exam.effects`, or None.
      first: number of the first episode, from which its noise is drawn.
    """

    def __init__(
        self,
        drones: DroneState,
        tasks: Task,
        ticks: int,
        seed: int,
        number: int = 0,
        cause: dict | None = None,
        first: int = 0,
    ):
        worlds, self.team = drones.position.shape[:2]
        count = worlds * self.team
        vehicles_told = [vehicle.Told()] * count
        sensors_drawn = sensors_of(seed, number)
        everyone = np.arange(count)
        parameters = vehicle.nominal_parameters(vehicles_told)
        sensors.apply_nuisances(parameters, everyone, sensors_drawn)
        ticks += 1  # a pose is measured after the last step, too
        arrival = np.repeat(10 * np.arange(ticks)[:, None], count, axis=1)
        if cause is not None:
            injection.inject(cause, parameters, everyone, arrival, rng_of(seed, number, 4, first))
        index = everyone.reshape(worlds, self.team)
        self.flight = plant.Flight(
            vehicles_told,
            parameters,
            air_of(sensors_drawn, seed, number, ticks, range(first, first + worlds), self.team),
            arrival,
            np.asarray(drones.position, float).reshape(count, 3).T,
            np.asarray(drones.quaternion, float).reshape(count, 4).T,
            partners=[np.roll(index, -shift, axis=1).ravel() for shift in range(1, self.team)],
            solids=solids_of(tasks, self.team),
        )
        self.flight.look()

    def poses(self) -> Poses:
        """Where the vehicles are."""
        body = self.flight.body
        return per_world(self.team, body.position, body.q, body.velocity)

    def measure(self) -> Poses:
        """Where the motion capture sees them."""
        return per_world(self.team, *self.flight.seen())

    def fly(self, command) -> None:
        """One tick."""
        self.flight.send(command.reshape(-1, 4).T)
        for _ in range(plant.PER_TICK):
            self.flight.step()
            self.flight.look()


def solids_of(tasks: Task, team: int) -> Solids:
    """What is solid in the worlds of `tasks`, for bodies of teams that are
    neighbours.
    """
    pillars = np.asarray(tasks.pillar_position, float)  # (W, P, 2)
    return Solids(
        pillar=np.repeat(np.moveaxis(pillars, (0, 1, 2), (2, 1, 0)), team, axis=2),
        active=np.repeat(np.asarray(tasks.pillar_active).T, team, axis=1),
        team=team,
    )
