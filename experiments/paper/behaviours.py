"""The paper's behaviours, measured and drawn.

The paper shows four by pictures: surrounding from both sides (wall), a shortcut instead
of following (narrow_gap), finding the evader behind pillars (random, and hidden, where
nobody sees it at the start), blocking all three ways out (passage). Here each is a
number for every method, beside one episode from above.
"""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.paper.roster import METHODS, flights_of
from experiments.table import Page, Table
from openjax.pursuit import SCENARIOS, PursuitSettings
from openjax.show.plots import draw_from_above
from openjax.show.trajectory import Trajectory

END = 0.5
"""wall: its ends are ways round at |y| beyond this (m); its pillars reach to .55."""
CORRIDORS = (-0.2, 0.3)
"""passage: the rows of pillars at these y (m) part three ways."""
EVERY = 8
"""Steps between the points of a path that is kept for the picture."""
SIGHT = {
    "seen": "first step in which anyone sees it",
    "lost": "share of steps until the capture without sight",
}
MEASURES = {
    "wall": {
        "both sides": "pursuers round both ends of the wall at the same time, before the capture"
    },
    "narrow_gap": {
        "met": "captured from ahead: the evader flies towards the one that catches it",
        "shorter way": "way of the one that catches it, as a share of the evader's",
    },
    "random": SIGHT,
    "hidden": SIGHT,
    "passage": {
        "three ways": "a pursuer in each of the three corridors at once, before the capture"
    },
}


def measure(layout: str, paths: Any, statistics: Any) -> dict[str, float | None]:
    """What `MEASURES` names, mean over B episodes; of those with a capture where only
    they tell ("met", "shorter way").

    Args:
        layout: a name of `MEASURES`.
        paths: pursuers (B, T, N, 3), evader (B, T, 3), seen (B, T), captured (B, T, N).
        statistics: `EpisodeStatistics` with leading axis B.
    """
    pursuers = np.asarray(paths.pursuers)
    evader = np.asarray(paths.evader)
    is_caught = np.asarray(statistics.captured)
    end = np.asarray(statistics.capture_step)
    is_before = np.arange(pursuers.shape[1])[None] < end[:, None]
    x = pursuers[..., 0]
    y = pursuers[..., 1]
    if layout == "wall":
        # beyond the middle plane or in line with the wall: not merely on the way there
        is_near = x < 0.15
        sides = [np.any(is_near & (sign * y > END), axis=-1) for sign in (1.0, -1.0)]
        return {"both sides": float(np.mean(np.any(sides[0] & sides[1] & is_before, axis=1)))}
    if layout == "passage":
        low, high = CORRIDORS
        ways = (y < low, (y > low) & (y < high), y > high)
        blocked = np.all([np.any(way, axis=-1) for way in ways], axis=0)
        return {"three ways": float(np.mean(np.any(blocked & is_before, axis=1)))}
    if layout == "narrow_gap":
        meetings = []
        ways = []
        for b in np.flatnonzero(is_caught):
            last = end[b] - 1
            who = int(np.argmax(paths.captured[b, last]))
            velocity = evader[b, last] - evader[b, max(last - 5, 0)]
            meetings.append(np.dot(velocity, pursuers[b, last, who] - evader[b, last]) > 0.0)
            ways.append(_way(pursuers[b, : last + 1, who]) / max(_way(evader[b, : last + 1]), 1e-6))
        return {"met": _mean(meetings), "shorter way": _mean(ways)}
    is_seen = np.asarray(paths.seen)
    first = np.where(is_seen.any(axis=1), is_seen.argmax(axis=1) + 1, is_seen.shape[1])
    unseen_share = np.sum(~is_seen & is_before, axis=1) / np.maximum(np.sum(is_before, axis=1), 1)
    return {"seen": float(np.mean(first)), "lost": float(np.mean(unseen_share))}


def one_episode(paths: Any) -> dict[str, list]:
    """The first episode's paths up to a second after its capture, thinned out."""
    is_caught = np.asarray(paths.captured[0]).any(axis=-1)
    end = (
        min(int(np.argmax(is_caught)) + 100, len(is_caught)) if is_caught.any() else len(is_caught)
    )

    def thin(values):
        return np.round(np.asarray(values)[0, :end:EVERY], 3).tolist()

    capture = int(np.argmax(is_caught)) // EVERY if is_caught.any() else None
    return {"pursuers": thin(paths.pursuers), "evader": thin(paths.evader), "capture": capture}


def _way(positions):
    return float(np.sum(np.linalg.norm(np.diff(positions, axis=0), axis=-1)))


def _mean(values):
    return float(np.mean(values)) if values else None


def page(results: dict) -> Page:
    """What `MEASURES` names, of every method."""
    rows = []
    for layout, measures in MEASURES.items():
        for name in measures:
            row = {"layout": layout, "name": name}
            for method in METHODS:
                records = flights_of(results, method)
                row[method] = [f["layouts"][layout]["behaviour"][name] for f in records]
            rows.append(row)
    meanings = [
        f"* {layout}, {n}: {text}" for layout, own in MEASURES.items() for n, text in own.items()
    ]
    columns = {"layout": "layout", "behaviour": "name"}
    return Page(
        "What the pursuers do",
        f"{results['episodes']} episodes per seed, speed clamp, drawn starts; mean (standard "
        "deviation over seeds). The "
        "paper names these behaviours and shows a picture of each; it has no numbers for them.",
        (
            "\n".join(meanings),
            Table(columns | {method: f"{method}:.3g" for method in METHODS}, rows),
            "![One episode of each method on each layout](behaviours.png)",
        ),
    )


def draw(results: dict, path: Path) -> None:
    """One episode of every method's first seed on the paper's four layouts."""
    layouts = [layout for layout in MEASURES if layout != "hidden"]
    methods = [method for method in METHODS if flights_of(results, method)]
    figure = Figure(figsize=(3.1 * len(methods), 3.3 * len(layouts)), layout="constrained")
    axes = figure.subplots(len(layouts), len(methods), squeeze=False)
    for i, layout in enumerate(layouts):
        for j, method in enumerate(methods):
            flown = flights_of(results, method)[0]["layouts"][layout]
            title = ", ".join(
                f"{n} {x:.2g}" for n, x in flown["behaviour"].items() if x is not None
            )
            draw_from_above(axes[i, j], trajectory_of(flown["paths"], layout, title))
            axes[i, j].title.set_fontsize("x-small")
            axes[i, j].set(
                xlabel=method if i == len(layouts) - 1 else "", ylabel=layout if j == 0 else ""
            )
    figure.savefig(path, dpi=70)


def trajectory_of(paths: dict, layout: str, title: str) -> Trajectory:
    """A kept path as what is drawn."""
    pursuers = np.array(paths["pursuers"])
    settings = PursuitSettings()
    captured = np.zeros(pursuers.shape[:2], bool)
    if paths["capture"] is not None:
        captured[paths["capture"] :] = True
    return Trajectory(
        title=title,
        pursuer_position=pursuers,
        pursuer_quaternion=np.broadcast_to([1.0, 0.0, 0.0, 0.0], (*pursuers.shape[:2], 4)),
        evader_position=np.array(paths["evader"]),
        captured=captured,
        crashed=np.zeros_like(captured),
        pillar_position=np.array(SCENARIOS[layout].pillars).reshape(-1, 2),
        arena_radius=settings.arena_radius,
        arena_height=settings.arena_height,
        pillar_radius=settings.pillar_radius,
        capture_radius=settings.capture_radius,
        time_step=EVERY * settings.time_step,
    )
