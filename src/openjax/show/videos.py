"""Animations of an episode, also where there's no display.

MuJoCo's renderer runs in a process of its own: an OpenGL driver that isn't there, or that crashes, can't take
the run with it. Where no backend works, matplotlib draws the episode from above and from the side.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont, ImageSequence

from openjax.files import replacing
from openjax.show.plots import EVADER_COLOR, PURSUER_COLORS, draw_arena
from openjax.show.trajectory import Trajectory

FRAMES_PER_SECOND = 12.5
_BACKENDS = ("egl", "osmesa", "glfw")
_RENDER_LIMIT = 120  # s for one backend
_LETTERS = 20  # pixels


def animate(path: Path, *trajectories: Trajectory, renderer: str = "auto") -> str:
    """Write an animated GIF up to a second after the first capture; time, capture and crash stand above it.

    Args:
      path: the .gif file.
      trajectories: the episode; of several, each is drawn below the one before.
      renderer: `mujoco`, `matplotlib` or `auto` (MuJoCo where an OpenGL backend works).

    Returns:
      The renderer that drew it: `mujoco` with the backend's name, or `matplotlib`.
    """
    films = []
    with tempfile.TemporaryDirectory() as directory:
        for i, trajectory in enumerate(trajectories):
            part = Path(directory) / f"{i}.gif"
            drawn_by = _animate_one(part, trajectory, renderer)
            films.append(_captioned(_frames_of(part), trajectory))
    write_gif(Path(path), _stacked(films))
    return drawn_by


def _animate_one(path, trajectory, renderer):
    if renderer != "matplotlib":
        backend = _animate_with_mujoco(path, trajectory)
        if backend is not None:
            return f"mujoco ({backend})"
        if renderer == "mujoco":
            raise RuntimeError("no OpenGL backend works here (tried MUJOCO_GL = egl, osmesa, glfw)")
    _animate_with_matplotlib(path, trajectory)
    return "matplotlib"


def frame_indices(trajectory: Trajectory) -> np.ndarray:
    """Steps that are drawn."""
    return np.arange(0, trajectory.end(), max(1, round(1.0 / (FRAMES_PER_SECOND * trajectory.time_step))))


def write_gif(path: Path, frames: list[np.ndarray]) -> None:
    """Write (H, W, 3) uint8 frames with one palette, which covers small coloured things too."""
    sample = np.concatenate(frames[:: max(1, len(frames) // 6)])
    palette = Image.fromarray(sample).quantize(255, method=Image.Quantize.MAXCOVERAGE)
    images = [Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    with replacing(path) as partial:
        images[0].save(
            partial, save_all=True, append_images=images[1:], duration=round(1000 / FRAMES_PER_SECOND), loop=0
        )


def caption(trajectory: Trajectory, step: int) -> tuple[str, str]:
    """What is written above the frame of a step: title and time; and what happened until then."""
    events = []
    for word, index in (("caught", trajectory.capture_index), ("crashed", trajectory.crash_index)):
        if index is not None and index <= step:
            events.append(f"{word} at {(index + 1) * trajectory.time_step:.1f} s")
    return f"{trajectory.title}: {(step + 1) * trajectory.time_step:.1f} s", ", ".join(events)


def _captioned(frames, trajectory):
    """Frames with a band above that says what one sees."""
    font, band = ImageFont.load_default(_LETTERS), round(2.8 * _LETTERS)
    captioned = []
    for frame, step in zip(frames, frame_indices(trajectory), strict=True):
        image = Image.new("RGB", (frame.shape[1], frame.shape[0] + band), "white")
        image.paste(Image.fromarray(frame), (0, band))
        pen = ImageDraw.Draw(image)
        for line, text in enumerate(caption(trajectory, int(step))):
            color = (190, 20, 20) if "crashed" in text else (0, 0, 0)
            pen.text((8, 4 + 1.3 * line * _LETTERS), text, fill=color, font=font)
        captioned.append(np.asarray(image))
    return captioned


def _frames_of(path):
    """The (H, W, 3) frames of a GIF."""
    with Image.open(path) as image:
        return [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(image)]


def _stacked(films):
    """Frames of films, each below the one before; those that end sooner keep their last frame."""
    width, length = max(film[0].shape[1] for film in films), max(len(film) for film in films)

    def wide(frame):
        return np.pad(frame, ((0, 0), (0, width - frame.shape[1]), (0, 0)), constant_values=255)

    return [np.concatenate([wide(film[min(i, len(film) - 1)]) for film in films]) for i in range(length)]


def _animate_with_mujoco(path, trajectory):
    chosen = os.environ.get("MUJOCO_GL")
    # glfw needs a display; asking for a window without one only prints warnings.
    usable = [name for name in _BACKENDS if name != "glfw" or os.environ.get("DISPLAY") or os.name == "nt"]
    with tempfile.TemporaryDirectory() as directory:
        flight, drawn = Path(directory) / "flight.npz", Path(directory) / "flight.gif"
        trajectory.save(flight)
        for backend in (chosen,) if chosen else usable:
            command = [sys.executable, "-m", "openjax.show.mujoco_rendering", str(flight), str(drawn)]
            environment = {**os.environ, "MUJOCO_GL": backend}
            if backend in ("egl", "osmesa"):
                environment["PYOPENGL_PLATFORM"] = backend
            try:
                done = subprocess.run(command, env=environment, capture_output=True, timeout=_RENDER_LIMIT)
            except (OSError, subprocess.TimeoutExpired):
                continue
            if done.returncode == 0 and drawn.exists():
                with replacing(path) as partial:
                    partial.write_bytes(drawn.read_bytes())
                return backend
    return None


def _animate_with_matplotlib(path, trajectory):
    figure = Figure(figsize=(8, 4.2), dpi=80, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    above, side = figure.subplots(1, 2)
    draw_arena(above, trajectory)
    limit = 1.08 * trajectory.arena_radius
    side.set(
        xlim=(-limit, limit),
        ylim=(0, 1.05 * trajectory.arena_height),
        xlabel="x [m]",
        ylabel="z [m]",
        aspect="equal",
    )
    for x in trajectory.pillar_position[:, 0]:
        side.axvspan(x - trajectory.pillar_radius, x + trajectory.pillar_radius, color="0.85")
    count = trajectory.pursuer_position.shape[1]
    colors = [PURSUER_COLORS[i % len(PURSUER_COLORS)] for i in range(count)] + [EVADER_COLOR]
    artists = [
        (
            above.plot([], [], color=c, linewidth=1)[0],
            above.plot([], [], "o", color=c)[0],
            side.plot([], [], "o", color=c)[0],
        )
        for c in colors
    ]
    bodies = np.concatenate([trajectory.pursuer_position, trajectory.evader_position[:, None]], axis=1)
    frames = []
    for i in frame_indices(trajectory):
        for body, (trail, dot, height) in enumerate(artists):
            trail.set_data(*bodies[max(0, i - 60) : i + 1, body, :2].T)
            dot.set_data(bodies[i, body, :1], bodies[i, body, 1:2])
            height.set_data(bodies[i, body, :1], bodies[i, body, 2:3])
        canvas.draw()
        frames.append(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    write_gif(path, frames)
