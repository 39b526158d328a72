"""Faults at their source, in simulated time: `python -m experiments.flying.simulated [--faults
3000] [--processes 4]`.

Three vehicles hunt in a layout; at a drawn moment something goes wrong
(`experiments.flying.faults`). Counted is where the *true* vehicles are, from then to the end: how
far out, how high, whether one fell or stayed armed. The vehicles are openjax's with the firmware's
watchdogs; policy, game, judge and state machine are those of `openjax fly`. In half of the flights
there is motion capture, which the estimators on board follow as far as it is believed.
"""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import jax
import numpy as np
import tyro

import openjax
from experiments.flying.faults import (
    ASLEEP,
    BEYOND,
    ENDING,
    FALL,
    FOLLOWED,
    KINDS,
    MARGIN,
    Fault,
    PoseDamage,
    draw_fault,
    finite,
    outcome,
)
from experiments.flying.single_thread import share_out, use_single_thread
from experiments.table import RESULTS, Page, Table, facts, write_page
from openjax.files import read_json, write_json
from openjax.flying.board import SILENCE
from openjax.flying.controller import Pose
from openjax.flying.estimation import see
from openjax.flying.game import game_functions, pose_array
from openjax.flying.safety import decide
from openjax.flying.set_point import from_action
from openjax.flying.state import Drone, Event, Mode, Request, initial_state
from openjax.flying.takeover import take_over
from openjax.pursuit import find_scenario, scenario_task
from openjax.pursuit.environment import THRUST_LIMIT
from openjax.vehicle import load_vehicle
from openjax.virtual_crazyflie.firmware import LEVEL_AFTER
from openjax.virtual_crazyflie.simulated import SimulatedSwarm, Uplink
from openjax.virtual_crazyflie.vehicles import VirtualVehicles

LATEST = 4.0
SECONDS = 14.0
"""Nothing begins to go wrong after; who flies then is asked to land (s)."""
OVER = "time is over"
"""The reason of these landings."""
PILLARS = 8
"""Room for as many in each layout, so that the game is compiled once."""
LAIN = 50
"""A flight whose vehicles lay on the floor with their motors off for so many ticks is over."""


@dataclass(frozen=True)
class Arguments:
    """Fly thousands of faults."""

    faults: int = 3000
    policy: str = "flight"
    layouts: tuple[str, ...] = ("wall", "random", "passage")
    seed: int = 0
    batch: int = 42
    """Worlds flown side by side."""
    processes: int = 4
    seconds_left: float = 1e9
    """Begin no batch that wouldn't be over by then (s)."""
    kinds: tuple[str, ...] = ("",)
    """Those that contain one of these; all by default."""
    level_after: float = LEVEL_AFTER
    """A firmware of one's own levels out so long (s) after the last set-point."""
    out: Path = RESULTS / "flying_faults.json"
    commit: str | None = None
    """Where git can't tell it."""


def fly(
    seeds: list[int], layout: str, policy_name: str, level_after: float = LEVEL_AFTER
) -> list[dict]:
    """Fly one fault per seed, side by side; a record of each. A seed below zero is a flight without
    fault.
    """
    worlds = Worlds([draw_fault(seed, LATEST) for seed in seeds], layout, policy_name)
    for firmware in worlds.swarm.firmware:
        firmware.level_after = level_after
    for _ in range(round((SECONDS + ENDING) / 0.01)):
        if not worlds.tick():
            break
    return worlds.records(seeds)


@functools.cache
def compiled_game(policy_name: str):
    """A policy's game: layout by name -> (layout, task); its settings, the airframe, and its two
    functions for flights side by side, the first one with the task as its first argument.
    """
    policy = openjax.load_policy(policy_name)
    game = policy.settings.environment

    def task_of(layout):
        scenario = find_scenario(layout, game)
        return scenario, scenario_task(replace(game, max_pillars=PILLARS), scenario)

    settings, airframe, first, tick = game_functions(policy)
    first = jax.jit(jax.vmap(first, in_axes=(None, 0)))
    return (
        task_of,
        settings,
        airframe,
        first,
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
        task_of, self.game, self.airframe, self._first, self._tick = compiled_game(policy_name)
        scenario, self._task = task_of(layout)
        self.faults, self.n, self._layout = faults, len(scenario.pursuers), layout
        starts = np.array(scenario.pursuers)
        self._damage = [damage(fault) for fault in faults]
        vehicles = VirtualVehicles(load_vehicle(), np.tile(starts, (len(faults), 1)))
        self._vehicles = vehicles
        following = [fault.kind != "camera drifts" for fault in faults for _ in range(self.n)]
        radio, camera = (
            functools.partial(self._received, source) for source in ("radio", "camera")
        )
        self.swarm = SimulatedSwarm(vehicles, following, radio, camera)
        pillars = [(x, y, self.game.pillar_radius) for x, y in scenario.pillars]
        state = initial_state([tuple(s) for s in starts.tolist()], pillars, self.airframe)
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
        others = [
            Pose(now, tuple(report.position[j].tolist()), (0.0,) * 3, tuple(report.quaternion[j].tolist()))
            for j in range(first, first + self.n)
        ] if fault.kind == "camera: bodies swapped" else ()  # fmt: skip
        return self._damage[w](source, i, now, pose, others)

    def tick(self) -> bool:
        """10 ms of all flights; whether any goes on."""
        now = self.swarm.now
        samples = list(self.swarm.observe())
        flown = np.flatnonzero(self._down < LAIN).tolist()
        awake = [w for w in flown if not (self.faults[w].kind == ASLEEP and self.faults[w].on(now))]
        over = set(range(len(self.faults))) - set(flown)
        self.swarm.asleep = {w * self.n + i for w in over for i in range(self.n)}
        for w in awake:
            first = w * self.n
            before = self.states[w].drones
            if self._landing[w]:  # who takes over knows no motion capture
                seen = samples[first : first + self.n]
                samples[first : first + self.n] = [s._replace(captured=None) for s in seen]
            self.states[w] = see(self.states[w], now, samples[first : first + self.n])
            for i, (drone, old) in enumerate(zip(self.states[w].drones, before, strict=True)):
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
            self._measured = self._first(self._task, poses)
        else:
            unseen = np.zeros(3, np.float32), np.zeros((), bool)
            self._measured = self._tick(*self._measured[:2], poses, *unseen)
            for w, caught in enumerate(np.asarray(self._measured[4])):
                if caught and self.captured[w] is None:
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
            self.states[w], self._landing[w] = take_over(self.states[w], now), True
        action = None if self._landing[w] else fault.answered(self._actions[w], now)
        actions = None if action is None else tuple(from_action(a, THRUST_LIMIT) for a in action)
        landing = on and (
            fault.kind == "key" or (fault.kind == "guard stopped" and since > 2.0 * SILENCE)
        )
        over = not landing and now >= SECONDS
        request = Request.LAND if landing or over else Request.NONE
        event = Event(now, samples, actions, request, OVER if over else "")
        self.states[w], wanted = decide(self.states[w], event)
        return list(wanted)

    def records(self, seeds) -> list[dict]:
        """What became of each flight."""
        track = np.array(self._tracks).reshape(len(self._tracks), len(self.faults), self.n, 4)
        return [{"seed": seed, **self._record(w, track[:, w])} for w, seed in enumerate(seeds)]

    def _record(self, w, track) -> dict:
        """Where the vehicles of flight w were from its fault on. track (T, N, 4): true position
        (m), motors off.
        """
        fault = self.faults[w]
        drones = self.states[w].drones
        position = track[..., :3]
        off = track[..., 3] > 0.0
        begin = min(fault.time, 0.01 * (len(track) - 1))
        seen = outcome(fault, 0.01 * np.arange(len(track)), position, off, begin)
        held = seen.pop("held")
        ended = any(d.reason not in ("", OVER) for d in drones)
        crashed = np.array([f.crashed for f in self.swarm.firmware[w * self.n : (w + 1) * self.n]])
        pairs = [position[:, i] - position[:, j] for i in range(3) for j in range(i)]
        return {
            "kind": fault.kind, "layout": self._layout, "captured_by_camera": fault.captured,
            **{k: v for k, v in asdict(fault).items() if k in ("time", "vehicle", "duration", "amount")},
            "ended": ended, "reasons": [d.reason for d in drones], **seen, "seconds": seen["seconds"] if ended else None,
            "hard": bool(crashed[held].any()), "armed": bool((~off[-1])[held].any()),
            "nearest": float(np.linalg.norm(pairs, axis=-1).min()), "caught": self.captured[w],
        }  # fmt: skip


PILOTS = ("loop stopped", "links stopped", "loop and links stopped", "loop and guard stopped")
"""Somebody else flies after a tenth of a second. (Which one takes over is for real processes:
`experiments.flying.real_time`.)
"""


def well(row: dict) -> bool:
    """Whether a flight ended as it must."""
    in_time = row["seconds"] is None or row["seconds"] <= ENDING or row["kind"] in SLOW
    return row["out"] <= MARGIN and not (row["fell"] or row["hard"] or row["armed"]) and in_time


SLOW = (
    "packets lost",
    "poses out of order",
    "camera scaled",
    "camera late",
    "camera drifts",
    FOLLOWED,
)
"""These may take effect long after they begin."""
ALL = "all but drifts that the estimator follows, and processes that stand still"


def summary(records) -> list[dict]:
    """A row per kind."""
    rows = []
    for kind in (*KINDS, "none", ALL):
        kinds = {*KINDS} - {*BEYOND} if kind == ALL else {kind}
        mine = [r for r in records if r["kind"] in kinds]
        if not mine:
            continue
        seconds = [r["seconds"] for r in mine if r["seconds"] is not None and r["kind"] not in SLOW]
        rows.append({
            "kind": kind, "faults": len(mine), "well": sum(map(well, mine)),
            "landed": sum(r["ended"] for r in mine), "out": sum(r["out"] > MARGIN for r in mine),
            "farthest": max(r["out"] for r in mine) + 0.9, "fell": sum(r["fell"] for r in mine),
            "hard": sum(r["hard"] for r in mine), "armed": sum(r["armed"] for r in mine),
            "longest": max(seconds, default=None), "nearest": min(r["nearest"] for r in mine),
        })  # fmt: skip
    return rows


def main() -> None:
    arguments = tyro.cli(Arguments)
    begin = time.time()
    jobs = []
    use_single_thread()  # before a worker imports JAX
    drawn = range(arguments.seed, arguments.seed + arguments.faults)
    seeds = [s for s in drawn if any(part in KINDS[s % len(KINDS)] for part in arguments.kinds)]
    for k, layout in enumerate(arguments.layouts):
        mine = [s for s in seeds if (s // len(KINDS)) % len(arguments.layouts) == k]
        mine += [-1] * (-len(mine) % arguments.batch)  # all batches are of one size: compiled once
        batches = [mine[i : i + arguments.batch] for i in range(0, len(mine), arguments.batch)]
        jobs += [(batch, layout, arguments.policy, arguments.level_after) for batch in batches]
    jobs.sort(
        key=lambda job: job[0][0]
    )  # whenever it stops, all kinds and layouts were flown as often
    records = []
    stands = facts(arguments.commit)
    try:
        for flown in share_out(fly, jobs, arguments.processes, arguments.seconds_left):
            records += flown
            write_json(arguments.out, {
                **stands, "policy": arguments.policy, "seconds": round(time.time() - begin),
                "summary": list(map(finite, summary(records))), "not_well": [finite(r) for r in records if not well(r)],
            })  # fmt: skip
    finally:  # of what was flown, also where something failed
        if records:
            write_page(arguments.out, page, read_json(arguments.out))


def page(results) -> Page:
    """Rows of `summary`."""
    prose = (
        f"{sum(r['faults'] for r in results['summary'] if r['kind'] in KINDS)} flights of three "
        "vehicles with the policy "
        f"`{results['policy']}`, one fault each, from its moment to the end. As they must: nobody "
        f"more than {MARGIN:g} m out "
        f"of the arena (.9 m), no fall from above {FALL:g} m, nobody down hard, nobody armed at "
        "the end, motors off on the "
        f"floor {ENDING:g} s after a fault that ends the flight."
    )
    columns = {
        "fault": "kind", "flights": "faults:d", "as they must": "well:d", "landed": "landed:d",
        "out by more than .1 m": "out:d", "farthest (m)": "farthest:.2f", "fell": "fell:d", "hard": "hard:d",
        "on at the end": "armed:d", "longest end (s)": "longest:.1f", "nearest two (m)": "nearest:.2f",
    }  # fmt: skip
    return Page(
        "Faults where they happen, in simulated time",
        prose,
        Table(columns, results["summary"]),
        by_group(results["summary"]),
    )


SHOWN = {
    "the camera sends something wrong, late or nothing": ("camera",),
    "... its drift, which the estimator on board follows": ("camera drifts, the",),
    "poses, gyroscope or packets are lost or wrong": ("poses", "packets", "gyroscope"),
    "processes stop": ("loop", "links", "guard"),
    "the policy is silent, stuck or wild": ("policy",),
    "a battery, a link or a drone fails, a key": ("battery", "drone", "link lost", "key"),
    "all processes stand still for a while": ("all processes",),
}
"""Rows of the page, by how the kinds begin; the longest beginning counts."""


def by_group(rows: list[dict]) -> Table:
    """The page's table: kinds of one source together."""
    starts = {start: group for group, own in SHOWN.items() for start in own}
    grouped: dict[str, list[dict]] = {group: [] for group in SHOWN}
    for row in rows:
        if row["kind"] in KINDS:
            start = max((s for s in starts if row["kind"].startswith(s)), key=len)
            grouped[starts[start]].append(row)
    added = ("faults", "well", "out", "fell", "hard", "armed")
    records = [
        {"group": group, "farthest": max(r["farthest"] for r in own)}
        | {name: sum(r[name] for r in own) for name in added}
        for group, own in grouped.items()
        if own
    ]
    columns = {
        "what fails": "group", "flights": "faults:d", "as they must": "well:d", "out by more than .1 m": "out:d",
        "farthest (m)": "farthest:.2f", "fell": "fell:d", "down hard": "hard:d", "on at the end": "armed:d",
    }  # fmt: skip
    return Table(columns, records)


if __name__ == "__main__":
    main()
