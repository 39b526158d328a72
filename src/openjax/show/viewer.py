"""Flown episodes in three dimensions, in a browser (viser)."""

import time
from collections.abc import Sequence

import numpy as np
import viser

from openjax.show.trajectory import Trajectory

PURSUERS = ((31, 119, 180), (44, 160, 44), (148, 103, 189), (140, 86, 75), (23, 190, 207), (127, 127, 127))
EVADER = (214, 39, 40)
TRAIL = 100
"""Steps of each vehicle's path that are drawn behind it."""


class Viewer:
    """A scene that plays episodes: choose a layout, play or drag the time.

    Args:
      server: where browsers look; `viser.ViserServer(port=...)`.
      flights: at least one episode.
    """

    def __init__(self, server: viser.ViserServer, flights: Sequence[Trajectory]):
        self.server = server
        self.flights = {flight.title: flight for flight in flights}
        titles = list(self.flights)
        self.layout = server.gui.add_dropdown("layout", titles, initial_value=titles[0])
        self.playing = server.gui.add_checkbox("play", True)
        self.speed = server.gui.add_slider("speed", min=0.1, max=2.0, step=0.1, initial_value=1.0)
        last = len(flights[0].evader_position) - 1
        self.step = server.gui.add_slider("step", min=0, max=last, step=1, initial_value=0)
        self.told = server.gui.add_markdown("")
        server.initial_camera.position = (-1.6, -1.6, 1.8)
        server.initial_camera.look_at = (0.0, 0.0, 0.5)
        self.layout.on_update(lambda _: self.build())
        self.step.on_update(lambda _: self.draw())
        self.build()

    @property
    def flight(self) -> Trajectory:
        """The episode that is shown."""
        return self.flights[self.layout.value]

    def build(self) -> None:
        """Put the chosen layout's arena, pillars and vehicles into the scene."""
        scene, flight = self.server.scene, self.flight
        scene.reset()
        height = flight.arena_height
        circle = np.linspace(0.0, 2 * np.pi, 65)
        ring = flight.arena_radius * np.stack([np.cos(circle), np.sin(circle), 0 * circle], axis=-1)
        for name, z in (("floor", 0.0), ("ceiling", height)):
            line = ring + np.array([0.0, 0.0, z])
            segments = np.stack([line[:-1], line[1:]], axis=1)
            scene.add_line_segments(f"/arena/{name}", segments, (150, 150, 150), thickness=0.005)
        for i, (x, y) in enumerate(flight.pillar_position):
            scene.add_cylinder(
                f"/pillar/{i}", flight.pillar_radius, height, (205, 190, 165), position=(x, y, height / 2)
            )
        number = flight.pursuer_position.shape[1]
        self.drones = []
        for i in range(number):
            frame = scene.add_frame(f"/pursuer_{i}", show_axes=False)
            colour = PURSUERS[i % len(PURSUERS)]
            scene.add_box(f"/pursuer_{i}/body", colour, dimensions=(0.04, 0.04, 0.02))
            for j, (x, y) in enumerate(((1, 1), (1, -1), (-1, -1), (-1, 1))):
                scene.add_cylinder(
                    f"/pursuer_{i}/rotor_{j}", 0.023, 0.004, colour, position=(0.03 * x, 0.03 * y, 0.012)
                )
            self.drones.append(frame)
        self.evader = scene.add_icosphere("/evader", 0.03, EVADER)
        self.reach = scene.add_icosphere("/reach", flight.capture_radius, EVADER, opacity=0.12)
        self.step.value = 0
        self.draw()

    def draw(self) -> None:
        """Put the vehicles where they are at the chosen step."""
        flight, k = self.flight, int(self.step.value)
        for i, frame in enumerate(self.drones):
            frame.position = flight.pursuer_position[k, i]
            frame.wxyz = flight.pursuer_quaternion[k, i]
        self.evader.position = self.reach.position = flight.evader_position[k]
        first = max(0, k - TRAIL)
        if k > first:
            paths = [*np.moveaxis(flight.pursuer_position, 1, 0), flight.evader_position]
            colours = [*(PURSUERS[i % len(PURSUERS)] for i in range(len(paths) - 1)), EVADER]
            points = np.concatenate([np.stack([p[first:k], p[first + 1 : k + 1]], axis=1) for p in paths])
            tinted = np.repeat(np.array(colours, np.uint8), k - first, axis=0)[:, None].repeat(2, axis=1)
            self.server.scene.add_line_segments("/paths", points, tinted, thickness=0.004)
        when = flight.capture_index
        caught = (
            f"captured after {(when + 1) * flight.time_step:.1f} s" if when is not None else "not captured"
        )
        self.told.content = f"{(k + 1) * flight.time_step:.2f} s — {caught}"

    def advance(self, seconds: float) -> None:
        """Let `seconds` pass; at its end an episode starts again."""
        if self.playing.value:
            steps = max(1, round(seconds * self.speed.value / self.flight.time_step))
            self.step.value = (int(self.step.value) + steps) % len(self.flight.evader_position)

    def play(self, frames_per_second: float = 25.0) -> None:
        """Play until interrupted."""
        while True:
            time.sleep(1.0 / frames_per_second)
            self.advance(1.0 / frames_per_second)
