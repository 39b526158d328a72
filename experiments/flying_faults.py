"""A thousand faults in simulated time: `python -m experiments.flying_faults [--faults 1000] [--processes 2]`.

Three vehicles hunt in a layout; at a drawn moment something goes wrong with one of them, or with the computer. Counted
is where every vehicle ends: landed inside the arena, or somewhere else. The vehicles are openjax's, with the firmware's
watchdogs; policy, game and state machine are those of `openjax fly`.

Kinds of faults:
* pose lost: no more poses of one vehicle, for good or for a while; its link still takes set-points
* packets lost: a share of poses and set-points of one vehicle is lost from then on
* computer stopped: no set-points for a while; then the guard lands all (see openjax.flying.guard)
* policy silent: the loop runs on, but no action comes
* battery low: one vehicle's voltage falls below the limit
* drone gone: one vehicle's link is dead in both directions; what it does then is up to its firmware's watchdog
* pose jumps: motion capture takes one vehicle for something half a metre away, or sees nonsense
* key: the operator lands all
"""

from __future__ import annotations

import json
import math
import random
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import tyro

KINDS = (
    "pose lost", "pose lost for a while", "packets lost", "computer stopped", "policy silent", "battery low",
    "drone gone", "pose jumps", "key",
)  # fmt: skip
START = 0.2
"""Nothing goes wrong before (s)."""
LATEST = 6.0
"""Nor begins after (s)."""
SECONDS = 13.0
"""Flown in all: a fault at the latest moment, a wait, a landing (s)."""
TICK = 0.01


@dataclass(frozen=True)
class Arguments:
    """Fly a thousand faults."""

    faults: int = 1000
    policy: str = "flight"
    layouts: tuple[str, ...] = ("wall", "random", "passage")
    seed: int = 0
    batch: int = 50
    """Worlds flown side by side."""
    processes: int = 2
    watchdog: bool = False
    """Feed the firmware's emergency-stop watchdog."""
    out: Path = Path(__file__).parent / "results" / "flying_faults.json"


@dataclass(frozen=True)
class Fault:
    """What goes wrong, when (s), with which vehicle, for how long (s), how much."""

    kind: str
    time: float
    vehicle: int
    duration: float = math.inf
    amount: float = 0.0


def draw_fault(seed: int, latest: float = LATEST) -> Fault:
    """The fault number `seed`, which begins by `latest` (s); the kinds take turns."""
    rng = random.Random(seed)
    kind = KINDS[seed % len(KINDS)]
    fault = partial(Fault, kind, rng.uniform(START, latest), rng.randrange(3))
    if kind == "pose lost for a while":
        return fault(duration=rng.uniform(0.05, 1.0))
    if kind == "packets lost":
        return fault(amount=rng.uniform(0.1, 0.7))
    if kind == "pose jumps":
        return fault(amount=rng.choice((-1.0, 1.0)) * rng.uniform(0.2, 0.8), duration=rng.uniform(0.02, 1.0))
    return fault()


def fly(
    seeds: list[int], layout: str, policy_name: str, watchdog=False, latest=LATEST, seconds=SECONDS
) -> list[dict]:
    """Fly one fault per seed, side by side; a record of each."""
    import dataclasses

    import jax

    import openjax
    from openjax.flying.controller import Airframe, Pose, moved_on
    from openjax.flying.game import game_functions, pose_array
    from openjax.flying.guard import TAKE_OVER, take_over
    from openjax.flying.limits import SafetySettings
    from openjax.flying.safety import Drone, Event, Mode, Request, initial_state, step
    from openjax.flying.set_point import from_action
    from openjax.pursuit import find_scenario, scenario_task
    from openjax.pursuit.environment import THRUST_LIMIT
    from openjax.vehicle import load_vehicle
    from openjax.virtual_crazyflie.simulated import SimulatedSwarm
    from openjax.virtual_crazyflie.vehicles import VirtualVehicles

    policy = openjax.load_policy(policy_name)
    game = policy.settings.environment
    scenario = find_scenario(layout, game)
    slots = max(game.max_pillars, len(scenario.pillars))
    task = scenario_task(dataclasses.replace(game, max_pillars=slots), scenario)
    settings, hover, first, tick = game_functions(policy, task)
    first, tick = jax.jit(jax.vmap(first)), jax.jit(jax.vmap(tick, in_axes=(0, 0, 0, None, None)))
    starts = np.array(scenario.pursuers)
    n, worlds = len(starts), len(seeds)
    faults = [draw_fault(seed, latest) for seed in seeds]
    swarm = SimulatedSwarm(
        VirtualVehicles(load_vehicle(), np.tile(starts, (worlds, 1)), flying=True), seeds[0], watchdog
    )
    safety = SafetySettings()
    pillars = [(x, y, settings.pillar_radius) for x, y in scenario.pillars]
    begin = initial_state([tuple(s) for s in starts.tolist()], pillars, Airframe(hover))
    begin = dataclasses.replace(begin, drones=(Drone(Mode.PURSUIT),) * n)
    states, guarded, gone = [begin] * worlds, [False] * worlds, np.zeros((worlds, n), bool)
    measured = None
    nowhere = (np.zeros(3, np.float32), np.zeros((), bool))
    tracks = []
    for _ in range(round(seconds / TICK)):
        now = swarm.now
        sightings = swarm.sightings()
        if any(state.modes.count(Mode.PURSUIT) for state in states):
            poses = pose_array([moved_on(s.pose, now) for s in sightings]).reshape(worlds, n, -1)
            if measured is None:
                measured = first(poses)
            else:
                measured = tick(*measured[:2], poses, *nowhere)
            actions = np.asarray(measured[1])
        set_points = []
        for w, fault in enumerate(faults):
            mine = slice(w * n, (w + 1) * n)
            since = now - fault.time
            on = 0.0 <= since < fault.duration
            apply_fault(swarm.faults[w * n + fault.vehicle], fault, on)
            gone[w, fault.vehicle] |= fault.kind == "drone gone" and on
            given = tuple(from_action(a, THRUST_LIMIT) for a in actions[w])
            if fault.kind == "policy silent" and on:
                given = None
            seen = sightings[mine]
            if fault.kind == "pose jumps" and on and fault.vehicle == 0:  # nonsense instead of a jump
                broken = seen[0].pose
                if broken is not None:
                    seen = (
                        dataclasses.replace(seen[0], pose=Pose(now, (math.nan,) * 3, *broken[2:])),
                        *seen[1:],
                    )
            request = Request.LAND if fault.kind == "key" and on else Request.NONE
            if fault.kind == "computer stopped" and on and not guarded[w]:
                if since < TAKE_OVER:
                    set_points += [None] * n
                    continue
                states[w], guarded[w] = take_over(safety, states[w], now), True
            states[w], wanted = step(safety, states[w], Event(now, seen, given, request))
            set_points += wanted
        swarm.send(set_points)
        swarm.advance()
        tracks.append(swarm.track.pop())
    track = np.array(tracks).reshape(len(tracks), worlds, n, 3)
    crashed = np.array([f.crashed for f in swarm.firmware]).reshape(worlds, n)
    return [
        record(faults[w], layout, seeds[w], states[w], track[:, w], gone[w], crashed[w], safety)
        for w in range(worlds)
    ]


def apply_fault(link, fault, on) -> None:
    """Do to one vehicle's link what the fault does while it is on."""
    lost = float(on and fault.kind in ("pose lost", "pose lost for a while", "drone gone"))
    share = fault.amount if on and fault.kind == "packets lost" else 0.0
    link.pose_loss = max(lost, share)
    link.command_loss = max(float(on and fault.kind == "drone gone"), share)
    link.voltage = 3.0 if on and fault.kind == "battery low" else None
    link.pose_jump = fault.amount if on and fault.kind == "pose jumps" and fault.vehicle != 0 else 0.0


def record(fault, layout, seed, state, track, gone, crashed, safety) -> dict:
    """Where the vehicles ended, and the farthest that each went. track (T, N, 3) m."""
    radius = np.linalg.norm(track[..., :2], axis=-1)
    down = track[-1, :, 2] < 0.02
    after = track[int(fault.time / TICK) :]
    far = np.linalg.norm(after[..., :2], axis=-1)
    return {
        "seed": seed, "kind": fault.kind, "layout": layout, "time": round(fault.time, 3), "vehicle": fault.vehicle,
        "amount": round(fault.amount, 3), "modes": [m.value for m in state.modes],
        "reasons": [d.reason for d in state.drones], "landed": down.tolist(), "gone": gone.tolist(),
        "crashed": crashed.tolist(),
        "radius_before": radius[: int(fault.time / TICK) + 1].max(0).round(3).tolist(),
        "radius": far.max(0).round(3).tolist(), "height": after[..., 2].max(0).round(3).tolist(),
        "end_radius": radius[-1].round(3).tolist(), "inside": (radius[-1] <= safety.arena_radius).tolist(),
    }  # fmt: skip


def summary(records) -> list[dict]:
    """One row per kind: vehicles that ended landed and inside, the farthest out; the gone ones apart."""
    rows = []
    for kind in (*KINDS, "all"):
        mine = [r for r in records if kind in ("all", r["kind"])]
        if not mine:
            continue
        held = [(r, i) for r in mine for i in range(3) if not r["gone"][i]]
        lost = [(r, i) for r in mine for i in range(3) if r["gone"][i]]
        rows.append({
            "kind": kind, "faults": len(mine), "vehicles": len(held),
            "landed": sum(r["landed"][i] or r["modes"][i] == "pursuit" for r, i in held),
            "inside": sum(r["inside"][i] for r, i in held),
            "hard": sum(r["crashed"][i] for r, i in held),
            "beyond_0.9": sum(r["radius"][i] > 0.9 for r, i in held),
            "beyond_1.0": sum(r["radius"][i] > 1.0 for r, i in held),
            "above_1.2": sum(r["height"][i] > 1.2 for r, i in held),
            "farthest": max(r["radius"][i] for r, i in held),
            "gone": len(lost), "gone_inside": sum(r["inside"][i] for r, i in lost),
            "gone_farthest": max((r["radius"][i] for r, i in lost), default=0.0),
        })  # fmt: skip
    return rows


def main() -> None:
    arguments = tyro.cli(Arguments)
    begin = time.time()
    seeds = range(arguments.seed, arguments.seed + arguments.faults)
    jobs = []
    for k, layout in enumerate(arguments.layouts):
        mine = [s for s in seeds if (s // len(KINDS)) % len(arguments.layouts) == k]
        jobs += [(mine[i : i + arguments.batch], layout) for i in range(0, len(mine), arguments.batch)]
    with ProcessPoolExecutor(arguments.processes, mp_context=get_context("spawn")) as pool:
        done = [pool.submit(fly, *job, arguments.policy, arguments.watchdog) for job in jobs]
        records = [r for job in done for r in job.result()]
    rows = summary(records)
    result = {
        "policy": arguments.policy,
        "watchdog": arguments.watchdog,
        "seconds": round(time.time() - begin),
        "summary": rows,
    }
    bad = [r for r in records if not all(np.array(r["landed"]) & np.array(r["inside"]) | np.array(r["gone"]))]
    arguments.out.write_text(json.dumps(result | {"not_well": bad}, indent=1) + "\n", encoding="utf-8")
    for row in rows:
        print(row)


if __name__ == "__main__":
    main()
