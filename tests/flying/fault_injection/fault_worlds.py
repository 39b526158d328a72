"""Worlds side by side in simulated time, one fault each: three vehicles hunt in a
layout, and at a drawn moment something goes wrong.

The vehicles are openjax's with the firmware's watchdogs; policy, game, judge and state
machine are those of `openjax fly`. In half of the flights there is motion capture,
which the estimators on board follow as far as it is believed.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

import openjax
from openjax.flying.board import SILENCE
from openjax.flying.controller import Pose
from openjax.flying.estimation import see
from openjax.flying.game import game_functions, pose_array
from openjax.flying.safety import decide
from openjax.flying.set_point import from_action
from openjax.flying.state import Drone, Event, Mode, Request, initial_state
from openjax.flying.takeover import take_over
from openjax.pursuit import PursuitSettings, find_scenario, scenario_task
from openjax.pursuit.environment import THRUST_LIMIT
from openjax.vehicle import load_vehicle
from openjax.virtual_crazyflie.firmware import LEVEL_AFTER
from openjax.virtual_crazyflie.vehicles import VirtualVehicles
from tests.flying.fault_injection.faults import (
    ASLEEP,
    ENDING,
    Fault,
    PoseDamage,
    draw_fault,
    outcome,
)
from tests.flying.fault_injection.simulated import SimulatedSwarm, Uplink

LATEST = 4.0
"""Nothing begins to go wrong after (s)."""
SECONDS = 14.0
"""Who flies then is asked to land (s)."""
OVER = "time is over"
"""The reason of these landings."""
PILLARS = 8
"""Room for as many in each layout, so that the game is compiled once."""
LAIN = 50
"""A flight whose vehicles lay on the floor with their motors off for so many ticks is
over.
"""
PILOTS = ("loop stopped", "links stopped", "loop and links stopped", "loop and guard stopped")
"""Somebody else flies after a tenth of a second. (Which one takes over is for real
processes: `processes` beside this file.)
"""


def fly(
    seeds: list[int], layout: str, policy_name: str, level_after: float = LEVEL_AFTER
) -> list[dict]:
    """Fly one fault per seed, side by side; a record of each. A seed below zero is a
    flight without fault.
    """
    worlds = Worlds([draw_fault(seed, LATEST) for seed in seeds], layout, policy_name)
    for firmware in worlds.swarm.firmware:
        firmware.level_after = level_after
    for _ in range(round((SECONDS + ENDING) / 0.01)):
        if not worlds.tick():
            break
    return worlds.records(seeds)


@dataclass(frozen=True)
class CompiledGame:
    """A policy's game for flights side by side; `first` has the task as its first
    argument.
    """

    trained_in: PursuitSettings
    settings: PursuitSettings
    airframe: Any
    first: Callable
    tick: Callable

    def layout(self, name: str):
        """A layout by name, and its task with room for as many pillars as any has."""
        game = replace(self.trained_in, max_pillars=PILLARS)
        scenario = find_scenario(name, self.trained_in)
        return scenario, scenario_task(game, scenario)


@functools.cache
def compiled_game(policy_name: str) -> CompiledGame:
    """The game of a policy, compiled once for all batches of flights."""
    policy = openjax.load_policy(policy_name)
    settings, airframe, first, tick = game_functions(policy)
    return CompiledGame(
        policy.settings.environment,
        settings,
        airframe,
        jax.jit(jax.vmap(first, in_axes=(None, 0))),
        jax.jit(jax.vmap(tick, in_axes=(0, 0, 0, None, None))),
    )


class Worlds:
    """Flights side by side, one fault each."""

    def __init__(
        self,
        faults: list[Fault],
        layout: str,
        policy_name: str,
        damage: Callable[[Fault], Callable] = PoseDamage,
    ):
        self._game = compiled_game(policy_name)
        scenario, self._task = self._game.layout(layout)
        self.faults = faults
        self.n = len(scenario.pursuers)
        self._layout = layout
        starts = np.array(scenario.pursuers)
        self._damage = [damage(fault) for fault in faults]
        vehicles = VirtualVehicles(load_vehicle(), np.tile(starts, (len(faults), 1)))
        self._vehicles = vehicles
        heard = [fault.kind != "camera drifts" for fault in faults for _ in range(self.n)]
        radio = functools.partial(self._received, "radio")
        camera = functools.partial(self._received, "camera")
        self.swarm = SimulatedSwarm(vehicles, heard, radio, camera)
        pillars = [(x, y, self._game.settings.pillar_radius) for x, y in scenario.pillars]
        state = initial_state([tuple(s) for s in starts.tolist()], pillars, self._game.airframe)
        state = state._replace(drones=(Drone(Mode.PURSUIT),) * self.n)
        self.states = [state] * len(faults)
        self._landing = [False] * len(faults)
        self._measured = None
        self._play = None
        self._tracks = []
        self.captured = [None] * len(faults)
        self._down = np.zeros(len(faults), int)  # ticks on the floor with motors off

    def _received(self, source, k, now, pose):
        w, i = divmod(k, self.n)
        fault = self.faults[w]
        if source == "camera" and not fault.captured:
            return None
        report = self._vehicles.report
        first = w * self.n
        others = ()
        if fault.kind == "camera: bodies swapped":
            places = [tuple(place) for place in report.position[first : first + self.n].tolist()]
            turns = [tuple(turn) for turn in report.quaternion[first : first + self.n].tolist()]
            others = [
                Pose(now, place, (0.0,) * 3, turn)
                for place, turn in zip(places, turns, strict=True)
            ]
        return self._damage[w](source, i, now, pose, others)

    def tick(self) -> bool:
        """10 ms of all flights; whether any goes on."""
        now = self.swarm.now
        samples = list(self.swarm.observe())
        worlds = np.flatnonzero(self._down < LAIN).tolist()
        awake = [
            w for w in worlds if not (self.faults[w].kind == ASLEEP and self.faults[w].on(now))
        ]
        over = set(range(len(self.faults))) - set(worlds)
        self.swarm.asleep = {w * self.n + i for w in over for i in range(self.n)}
        for w in awake:
            first = w * self.n
            drones = self.states[w].drones
            if self._landing[w]:  # who takes over knows no motion capture
                of_world = samples[first : first + self.n]
                samples[first : first + self.n] = [s._replace(captured=None) for s in of_world]
            self.states[w] = see(self.states[w], now, samples[first : first + self.n])
            for i, (drone, old) in enumerate(zip(self.states[w].drones, drones, strict=True)):
                if drone.captured.pose is not old.captured.pose and drone.feeds_estimator:
                    self.swarm.believed(first + i, drone.captured.pose)
        if any(Mode.PURSUIT in state.modes for state in self.states):
            self._play_on()
        set_points = [None] * len(samples)
        for w in awake:
            mine = slice(w * self.n, (w + 1) * self.n)
            set_points[mine] = self._flown(w, now, samples[mine])
        self.swarm.send(set_points)
        self.swarm.advance()
        report = self.swarm.vehicles.report
        off = np.array([f.set_point(self.swarm.now).mode == 0 for f in self.swarm.firmware])
        self._tracks.append(np.column_stack([report.position, off]))
        down = ((report.position[:, 2] < 0.02) & off).reshape(-1, self.n).all(1)
        self._down = np.where(down, self._down + 1, 0)
        return bool((self._down < LAIN).any())

    def _play_on(self):
        poses = [drone.estimate for state in self.states for drone in state.drones]
        poses = pose_array(poses).reshape(len(self.faults), self.n, -1)
        if self._measured is None:
            self._measured = self._game.first(self._task, poses)
        else:
            unseen = np.zeros(3, np.float32), np.zeros((), bool)
            self._measured = self._game.tick(*self._measured[:2], poses, *unseen)
            for w, is_caught in enumerate(np.asarray(self._measured[4])):
                if is_caught and self.captured[w] is None:
                    self.captured[w] = len(self._tracks)
        self._actions = np.asarray(self._measured[1])

    def _flown(self, w, now, samples):
        """The set-points of flight w at this tick; None where none is sent."""
        fault = self.faults[w]
        since = now - self.faults[w].time
        on = fault.on(now)
        vehicle = w * self.n + fault.vehicle
        voltages = {"battery low": 3.0, "battery unknown": math.nan}
        self.swarm.uplinks[vehicle] = Uplink(
            fault.losses(now)[0], voltages.get(fault.kind) if on else None
        )
        if on and fault.kind == "drone restarts":
            self.swarm.firmware[vehicle].restart()
        if on and fault.kind in PILOTS and not self._landing[w]:
            if since < SILENCE:
                return [None] * self.n
            self.states[w] = take_over(self.states[w], now)
            self._landing[w] = True
        action = None if self._landing[w] else fault.answered(self._actions[w], now)
        actions = None if action is None else tuple(from_action(a, THRUST_LIMIT) for a in action)
        landing = on and (
            fault.kind == "key" or (fault.kind == "guard stopped" and since > 2.0 * SILENCE)
        )
        over = not landing and now >= SECONDS
        request = Request.LAND if landing or over else Request.NONE
        event = Event(now, samples, actions, request, OVER if over else "")
        self.states[w], set_points = decide(self.states[w], event)
        return list(set_points)

    def records(self, seeds) -> list[dict]:
        """What became of each flight."""
        track = np.array(self._tracks).reshape(len(self._tracks), len(self.faults), self.n, 4)
        return [{"seed": seed, **self._record(w, track[:, w])} for w, seed in enumerate(seeds)]

    def _record(self, w, track) -> dict:
        """Where the vehicles of flight w were from its fault on. track (T, N, 4): true
        position (m), motors off.
        """
        fault = self.faults[w]
        drones = self.states[w].drones
        position = track[..., :3]
        off = track[..., 3] > 0.0
        begin = min(fault.time, 0.01 * (len(track) - 1))
        result = outcome(fault, 0.01 * np.arange(len(track)), position, off, begin)
        is_held = result.pop("held")
        is_over = any(d.reason not in ("", OVER) for d in drones)
        crashed = np.array([f.crashed for f in self.swarm.firmware[w * self.n : (w + 1) * self.n]])
        pairs = [position[:, i] - position[:, j] for i in range(3) for j in range(i)]
        return {
            "kind": fault.kind,
            "layout": self._layout,
            "captured_by_camera": fault.captured,
            **{name: getattr(fault, name) for name in ("time", "vehicle", "duration", "amount")},
            "ended": is_over,
            "reasons": [d.reason for d in drones],
            **result,
            "seconds": result["seconds"] if is_over else None,
            "hard": bool(crashed[is_held].any()),
            "armed": bool((~off[-1])[is_held].any()),
            "nearest": float(np.linalg.norm(pairs, axis=-1).min()),
            "caught": self.captured[w],
        }
