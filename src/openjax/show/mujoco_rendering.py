"""Draws an episode with MuJoCo's renderer: `python -m openjax.show.mujoco_rendering FLIGHT.npz OUT.gif`.

The scene is for the eye only: bodies are moved by the recorded poses, nothing is simulated.
"""

import itertools
import sys
from pathlib import Path

import mujoco
import numpy as np

from openjax.show.trajectory import Trajectory
from openjax.show.videos import frame_indices, write_gif

WIDTH, HEIGHT = 560, 400
TRAIL = 1.2
"""Seconds of each path that are drawn behind a vehicle."""
SCALE = 1.5
"""Pursuers are drawn so many times as large as they are, to be seen."""
_COLORS = (
    ".12 .47 .71 1", ".17 .63 .17 1", ".58 .40 .74 1", ".09 .75 .81 1",
    ".74 .74 .13 1", ".55 .34 .29 1", ".0 .0 .5 1", ".0 .5 .5 1",
)  # fmt: skip
_ARM = 0.043 * SCALE  # m, centre to rotor


def scene(trajectory: Trajectory) -> str:
    """MJCF of arena, pillars, pursuers (bodies p0, p1, ...) and evader (body e), all bodies mocap."""
    radius, height = trajectory.arena_radius, trajectory.arena_height
    pillars = "".join(
        f'<geom type="cylinder" pos="{x} {y} {height / 2}" size="{trajectory.pillar_radius} {height / 2}" '
        'rgba=".72 .66 .55 .8"/>'
        for x, y in trajectory.pillar_position
    )
    angles = np.linspace(0, 2 * np.pi, 49)
    circle = radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    wall = "".join(
        f'<geom type="capsule" size=".004" rgba=".3 .3 .3 {alpha}" fromto="{xa} {ya} {z} {xb} {yb} {z}"/>'
        for z, alpha in ((0.005, 0.8), (height, 0.25))
        for (xa, ya), (xb, yb) in itertools.pairwise(circle)
    )
    offset = _ARM / np.sqrt(2)
    rotors = "".join(
        f'<geom type="cylinder" pos="{sx * offset} {sy * offset} .018" size="{0.023 * SCALE} .002"/>'
        for sx in (-1, 1)
        for sy in (-1, 1)
    )
    arms = "".join(
        f'<geom type="capsule" size=".004" fromto="{-offset} {-sy * offset} 0 {offset} {sy * offset} 0"/>'
        for sy in (-1, 1)
    )
    pursuers = "".join(
        f'<body name="p{i}" mocap="true">{_colored(rotors + arms, _COLORS[i % len(_COLORS)])}'
        '<geom type="box" size=".016 .016 .008" rgba=".1 .1 .1 1"/></body>'
        for i in range(trajectory.pursuer_position.shape[1])
    )
    return f"""
<mujoco>
  <visual>
    <global offwidth="{WIDTH}" offheight="{HEIGHT}"/>
    <headlight ambient=".4 .4 .4" diffuse=".3 .3 .3" specular="0 0 0"/>
    <quality shadowsize="1024"/>
  </visual>
  <asset>
    <texture name="sky" type="skybox" builtin="flat" rgb1="1 1 1" rgb2="1 1 1" width="8" height="8"/>
  </asset>
  <worldbody>
    <light pos="0 0 4" dir="0 0 -1" directional="true" diffuse=".35 .35 .35" specular="0 0 0"/>
    <geom type="cylinder" size="{radius} .002" rgba=".86 .88 .9 1"/>
    {pillars}{wall}{pursuers}
    <body name="e" mocap="true"><geom type="sphere" size=".045" rgba=".84 .15 .16 1"/></body>
  </worldbody>
</mujoco>"""


def render(trajectory: Trajectory) -> list[np.ndarray]:
    """(HEIGHT, WIDTH, 3) uint8 frames; the evader turns golden while it's captured."""
    model = mujoco.MjModel.from_xml_string(scene(trajectory))
    data = mujoco.MjData(model)
    count = trajectory.pursuer_position.shape[1]
    evader_geom = model.body("e").geomadr[0]
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (0, 0, 0.38 * trajectory.arena_height)
    camera.distance, camera.azimuth, camera.elevation = 3.0 * trajectory.arena_radius / 0.9, 60, -42
    frames = []
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer:
        for i in frame_indices(trajectory):
            data.mocap_pos[:count] = trajectory.pursuer_position[i]
            data.mocap_quat[:count] = trajectory.pursuer_quaternion[i]
            data.mocap_pos[count] = trajectory.evader_position[i]
            if trajectory.captured[i].any():
                model.geom_rgba[evader_geom] = (1.0, 0.8, 0.1, 1.0)
            else:
                model.geom_rgba[evader_geom] = (0.84, 0.15, 0.16, 1.0)
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            _draw_trails(renderer.scene, trajectory, i)
            frames.append(renderer.render().copy())
    return frames


def _draw_trails(scene, trajectory, step):
    """Add the last second of every path to a scene, thinner and fainter the longer ago it was."""
    paths = [*np.moveaxis(trajectory.pursuer_position, 1, 0), trajectory.evader_position]
    colors = [*(_COLORS[i % len(_COLORS)] for i in range(len(paths) - 1)), ".84 .15 .16 1"]
    every = max(1, round(0.04 / trajectory.time_step))
    first = max(0, step - round(TRAIL / trajectory.time_step))
    for path, color in zip(paths, colors, strict=True):
        for k in range(step, first, -every):
            if scene.ngeom == scene.maxgeom:
                return
            age = (step - k) / max(step - first, 1)
            rgba = np.array([*map(float, color.split()[:3]), 0.75 * (1 - age)], np.float32)
            geom = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(
                geom, mujoco.mjtGeom.mjGEOM_CAPSULE, np.zeros(3), np.zeros(3), np.zeros(9), rgba
            )
            ends = (path[max(k - every, first)].astype(float), path[k].astype(float))
            mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_CAPSULE, 0.007 * (1 - 0.6 * age), *ends)
            scene.ngeom += 1


def _colored(geoms, color):
    return geoms.replace("/>", f' rgba="{color}"/>')


if __name__ == "__main__":
    write_gif(Path(sys.argv[2]), render(Trajectory.load(Path(sys.argv[1]))))
