"""The game of a flight, played by the worker that the flight was forked from; and the
laboratory's cameras.
"""

import contextlib
import time

import numpy as np

from tests.flying.fault_injection.faults import Fault, PoseDamage


def feed_of(fault: Fault, truth):
    """What a laboratory's adapter would be: poses of a camera at 100 Hz, damaged."""
    damage = PoseDamage(fault)
    noise = np.random.default_rng(7)

    def feed(update):
        due = time.perf_counter()
        while True:
            # before the take-off, too
            now = max(time.perf_counter() - truth.take_off, -1.0)
            poses = truth.poses()
            for i, pose in enumerate(poses):
                shaken = tuple((np.array(pose.position) + noise.normal(0, 5e-4, 3)).tolist())
                shown = damage("camera", i, now, pose._replace(position=shaken), poses)
                if shown is not None:
                    update(i, shown.position, shown.quaternion)
            due += 0.01
            time.sleep(max(due - time.perf_counter(), 0.0))

    return feed


class RemoteGame:
    """The game of a flight, played by the worker; `spoil` makes of each play what the
    policy is said to have answered.
    """

    def __init__(self, game, pipe, spoil):
        self.task = game.task
        self.settings = game.settings
        self.airframe = game.airframe
        self._pipe = pipe
        self._spoil = spoil

    def start(self, poses):
        """See `openjax.flying.game.Game.start`."""
        self._pipe.send(("start", (poses,)))
        return self._pipe.recv()

    def step(self, poses, evader=None):
        """See `openjax.flying.game.Game.step`."""
        self._pipe.send(("step", (poses, evader)))
        return self._spoil(self._pipe.recv())


def play(game, pipe) -> None:
    """Answer a `RemoteGame` until its process ends."""
    with contextlib.suppress(EOFError, OSError):
        while True:
            name, arguments = pipe.recv()
            pipe.send(getattr(game, name)(*arguments))
