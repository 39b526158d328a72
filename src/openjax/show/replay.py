"""Flown episodes as one HTML page that needs nothing else: to watch, and to send to
somebody.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from openjax.files import write_text
from openjax.show.trajectory import Trajectory

LONGEST_STEP = 0.025
"""Frames are no further apart (s), so that a browser moves smoothly."""
AHEAD = 3
"""Predicted positions that are shown, spread over the predictor's horizons."""
TEMPLATE = Path(__file__).with_name("replay.html")


def replay_page(flights: Sequence[tuple[str, Trajectory]]) -> str:
    """The page's text.

    Args:
      flights: (policy's name, episode) pairs; an episode's title is its layout's name.
    """
    data = json.dumps(
        [plain_episode(policy, flight) for policy, flight in flights], separators=(",", ":")
    )
    # within a script element "<" may only stand escaped
    return TEMPLATE.read_text(encoding="utf-8").replace("@DATA@", data.replace("<", "\\u003c"))


def write_replay(path: Path, flights: Sequence[tuple[str, Trajectory]]) -> None:
    """Write the page of (policy's name, episode) pairs, or nothing."""
    write_text(path, replay_page(flights))


def plain_episode(policy: str, flight: Trajectory) -> dict:
    """The data of an episode for the page's script, up to two seconds after its capture: lengths in
    mm, quaternions in thousandths, times in frames.
    """
    every = max(1, round(LONGEST_STEP / flight.time_step))
    steps = slice(0, flight.end(seconds=2.0), every)

    def thousandths(values):
        return np.rint(1000.0 * np.asarray(values, float)).astype(int).ravel().tolist()

    def frame(index):
        """The frame of a step; None for no step, or one after the last frame."""
        return None if index is None or index // every >= len(poses) else index // every

    poses = np.concatenate([flight.pursuer_position, flight.pursuer_quaternion], axis=-1)[steps]
    plain = {
        "layout": flight.title,
        "policy": policy,
        "dt": every * flight.time_step,
        "steps": len(poses),
        "radius": flight.arena_radius,
        "height": flight.arena_height,
        "pillarRadius": flight.pillar_radius,
        "captureRadius": flight.capture_radius,
        "pillars": np.asarray(flight.pillar_position, float).round(4).tolist(),
        "pursuers": [thousandths(pose) for pose in np.moveaxis(poses, 1, 0)],
        "evader": thousandths(flight.evader_position[steps]),
        "capture": frame(flight.capture_index),
        "crashes": [frame(flight.crash_of(i)) for i in range(poses.shape[1])],
        "seen": [] if flight.seen is None else _spans(flight.seen[steps]),
    }
    if flight.predicted is not None:
        horizons = np.linspace(0, flight.predicted.shape[1] - 1, AHEAD).round().astype(int)
        plain |= {"predicted": thousandths(flight.predicted[steps][:, horizons]), "ahead": AHEAD}
    return plain


def _spans(flags: np.ndarray) -> list[list[int]]:
    """[first, last] of each run of true flags (T,)."""
    # with a zero before and after, edges come in pairs: where a run begins, and one
    # past its end
    flags_with_ends = np.concatenate([[0], np.asarray(flags, int), [0]])
    edges = np.flatnonzero(np.diff(flags_with_ends))
    return [[int(first), int(end) - 1] for first, end in edges.reshape(-1, 2)]
