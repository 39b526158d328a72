"""Animations of an episode, drawn in perspective by Pillow: the same on every machine,
without display or OpenGL.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial.transform import Rotation

from openjax.files import replacing
from openjax.show.plots import EVADER_COLOR, PURSUER_COLORS
from openjax.show.trajectory import Trajectory

FRAMES_PER_SECOND = 12.5  # one of eight steps of 10 ms
WIDTH = 560
HEIGHT = 400
FINER = 2
"""Frames are drawn so many times as large and then reduced, so that edges are
smooth.
"""
AZIMUTH, ELEVATION, OPENING = np.radians((60.0, 42.0, 45.0))
"""Where the camera looks from, and its vertical field of view."""
DISTANCE = 3.3
"""Of the camera from the arena's middle, in radii of the arena."""
TRAIL = 1.2
"""Seconds of each path that are drawn behind a vehicle."""
ARM = 0.065
ROTOR = 0.035
BALL = 0.045
"""Metres from a vehicle's centre to a rotor, a rotor's radius, the evader's: larger
than they are, to be seen.
"""
_ROTORS = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]) / np.sqrt(2)
_LETTERS = 20  # pixels


def animate(path: Path, trajectories: Sequence[Trajectory]) -> None:
    """Write an animated GIF up to a second after the first capture, with time, capture and crash
    above it.

    Args:
      path: the .gif file.
      trajectories: the episode; of several, each is drawn below the one before.
    """
    films = []
    for flight in trajectories:
        every = max(1, round(1.0 / (FRAMES_PER_SECOND * flight.time_step)))
        films.append([_frame(flight, step) for step in range(0, flight.end(), every)])
    frames = _stack(films)
    # one palette for all frames, from six of them, by the method that gives small
    # coloured things their colours, too
    sample = np.concatenate(frames[:: max(1, len(frames) // 6)])
    palette = Image.fromarray(sample).quantize(255, method=Image.Quantize.MAXCOVERAGE)
    images = [
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    ]
    with replacing(path) as partial_file:
        images[0].save(
            partial_file,
            save_all=True,
            append_images=images[1:],
            duration=round(1000 / FRAMES_PER_SECOND),
            loop=0,
        )


def _stack(films):
    """Frames of films, each below the one before; those that end sooner keep their last
    frame.
    """
    length = max(map(len, films))
    return [np.concatenate([film[min(i, len(film) - 1)] for film in films]) for i in range(length)]


def caption(trajectory: Trajectory, step: int) -> tuple[str, str]:
    """The caption of a step's frame: title, time, and what happened until then."""
    events = []
    for word, index in (("caught", trajectory.capture_index), ("crashed", trajectory.crash_index)):
        if index is not None and index <= step:
            events.append(f"{word} at {(index + 1) * trajectory.time_step:.1f} s")
    return f"{trajectory.title}: {(step + 1) * trajectory.time_step:.1f} s", ", ".join(events)


def _frame(trajectory, step):
    """(H, W, 3) uint8: the scene below a band that says what one sees."""
    band = round(2.8 * _LETTERS)
    font = ImageFont.load_default(_LETTERS)
    image = Image.new("RGB", (WIDTH, HEIGHT + band), "white")
    image.paste(draw(trajectory, step), (0, band))
    pen = ImageDraw.Draw(image)
    for line, text in enumerate(caption(trajectory, step)):
        color = (190, 20, 20) if "crashed" in text else (0, 0, 0)
        pen.text((8, 4 + 1.3 * line * _LETTERS), text, fill=color, font=font)
    return np.asarray(image)


def draw(trajectory: Trajectory, step: int) -> Image.Image:
    """The scene of one step; the evader is golden while it's captured."""
    image = Image.new("RGB", (FINER * WIDTH, FINER * HEIGHT), "white")
    pen = _Pen(image, trajectory.arena_radius, trajectory.arena_height)
    pen.arena()
    things = list(_things(pen, trajectory, step))
    for _, _, outlines in things:
        for outline in outlines:
            pen.fill(outline * (1, 1, 0), (60, 60, 60, 70))  # its shadow
    # the painter's way: what is far first, what is near over it
    for _, draw_it, _ in sorted(things, key=lambda thing: -pen.depth(thing[0])):
        draw_it()
    return image.reduce(FINER)


def _things(pen, trajectory, step):
    """(place, function that draws it, outlines of its shadow) of all that stands or
    flies in the scene.
    """
    for place in trajectory.pillar_position:
        yield place, partial(pen.pillar, place, trajectory.pillar_radius), ()
    bodies = Rotation.from_quat(trajectory.pursuer_quaternion[step], scalar_first=True).as_matrix()
    for i, body in enumerate(bodies):
        color = _rgb(PURSUER_COLORS[i % len(PURSUER_COLORS)])
        path = trajectory.pursuer_position[:, i]
        rotors = path[step] + (ARM * _ROTORS[:, None] + ROTOR * _circle(12)) @ body.T
        yield path[step], partial(pen.vehicle, rotors, color), rotors
        yield from _trail(pen, path, step, color, trajectory.time_step)
    color = _rgb(EVADER_COLOR)
    path = trajectory.evader_position
    ball_color = (255, 200, 25) if trajectory.captured[step].any() else color
    shadow = path[step] + BALL * _circle(24)
    yield path[step], partial(pen.ball, path[step], BALL, ball_color), [shadow]
    yield from _trail(pen, path, step, color, trajectory.time_step)


def _trail(pen, path, step, color, time_step):
    """The last second of a path, fainter the longer ago it was."""
    every = max(1, round(0.04 / time_step))
    length = round(TRAIL / time_step)
    for end in range(step, max(0, step - length), -every):
        points = path[[max(end - every, 0), end]]
        faint = round(190 * (1 - (step - end) / length))
        yield points.mean(axis=0), partial(pen.line, points, (*color, faint), 4), ()


class _Pen:
    """Draws into an image what is given in metres, as a camera above the arena's edge
    sees it.
    """

    def __init__(self, image: Image.Image, radius: float, height: float):
        self._draw = ImageDraw.Draw(image, "RGBA")
        self._radius = radius
        self._height = height
        self._middle = np.array(image.size) / 2
        ca, ce = np.cos((AZIMUTH, ELEVATION))
        sa, se = np.sin((AZIMUTH, ELEVATION))
        right = (sa, -ca, 0)
        down = (-se * ca, -se * sa, -ce)
        forward = (ce * ca, ce * sa, -se)
        self._axes = np.array([right, down, forward])
        # looks at a point somewhat below half the height: the floor's near edge needs
        # room
        self._camera = (0, 0, 0.38 * height) - DISTANCE * radius * self._axes[2]

    def depth(self, place) -> float:
        """The order in which things hide each other: how far off along the floor, as pillars reach
        all the way up.
        """
        return float(self._axes[2, :2] @ place[:2])

    def _pixels(self, points):
        from_camera = (np.asarray(points, float) - self._camera) @ self._axes.T
        zoom = self._middle[1] / np.tan(OPENING / 2)
        pixels = self._middle + zoom * from_camera[:, :2] / from_camera[:, 2:]
        return [tuple(pixel) for pixel in pixels]

    def fill(self, outline, color) -> None:
        """A polygon (M, 3)."""
        self._draw.polygon(self._pixels(outline), fill=color)

    def line(self, points, color, width) -> None:
        """A line through points (M, 3)."""
        self._draw.line(self._pixels(points), fill=color, width=width, joint="curve")

    def arena(self) -> None:
        """The floor, and the wall's lower and upper edge."""
        edge = self._radius * _circle(96)
        self.fill(edge, (219, 224, 230))
        for z, faint in ((0, 200), (self._height, 80)):
            self.line(edge + np.array((0, 0, z)), (77, 77, 77, faint), 3)

    def pillar(self, place, radius) -> None:
        """A translucent cylinder up to the arena's height, lit from the right."""
        foot = (*place, 0) + radius * _circle(24)
        top = foot + np.array((0, 0, self._height))
        for i, normal in enumerate(_circle(48)[1::2]):
            if normal @ self._axes[2] < 0:  # towards the camera
                self.fill(
                    [foot[i], foot[i + 1], top[i + 1], top[i]],
                    _wood(0.68 + 0.2 * normal @ self._axes[0]),
                )
        self.fill(top, _wood(0.95))

    def vehicle(self, rotors, color) -> None:
        """Four rotors (4, M, 3) on their arms."""
        hubs = rotors[:, 1:].mean(axis=1)
        for arm in (hubs[::2], hubs[1::2]):
            self.line(arm, (30, 30, 30), 6)
        for rotor in rotors:
            self.fill(rotor, (*color, 235))

    def ball(self, place, radius, color) -> None:
        """A ball, brighter above."""
        for size, light in ((1.0, 0.75), (0.7, 1.0)):
            # the bright part is smaller and farther up
            centre = place - 0.7 * (1 - size) * radius * self._axes[1]
            outline = centre + size * radius * _circle(24)[:, :2] @ self._axes[:2]
            self.fill(outline, tuple(round(light * part) for part in color))


def _circle(corners):
    """(corners + 1, 3) points of a circle about the origin, closed."""
    angles = np.linspace(0, 2 * np.pi, corners + 1)
    return np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)


def _rgb(name):
    return tuple(round(255 * part) for part in to_rgb(name))


def _wood(light):
    return (*(round(light * part) for part in (200, 184, 158)), 205)
