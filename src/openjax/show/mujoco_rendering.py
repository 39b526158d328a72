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

WIDTH, HEIGHT = 480, 400
_COLORS = (
    ".12 .47 .71 1", ".17 .63 .17 1", ".58 .40 .74 1", ".09 .75 .81 1",
    ".74 .74 .13 1", ".55 .34 .29 1", ".0 .0 .5 1", ".0 .5 .5 1",
)  # fmt: skip
_ARM = 0.043  # m, centre to rotor


def scene(trajectory: Trajectory) -> str:
    """MJCF of arena, pillars, pursuers (bodies p0, p1, ...) and evader (body e), all bodies mocap."""
    radius, height = trajectory.arena_radius, trajectory.arena_height
    pillars = "".join(
        f'<geom type="cylinder" pos="{x} {y} {height / 2}" size="{trajectory.pillar_radius} {height / 2}" '
        'rgba=".5 .5 .58 .45"/>'
        for x, y in trajectory.pillar_position
    )
    angles = np.linspace(0, 2 * np.pi, 49)
    circle = radius * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    wall = "".join(
        f'<geom type="capsule" size=".004" rgba=".2 .2 .2 .6" fromto="{xa} {ya} {z} {xb} {yb} {z}"/>'
        for z in (0.005, height)
        for (xa, ya), (xb, yb) in itertools.pairwise(circle)
    )
    offset = _ARM / np.sqrt(2)
    rotors = "".join(
        f'<geom type="cylinder" pos="{sx * offset} {sy * offset} .012" size=".023 .002"/>'
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
    <headlight ambient=".45 .45 .45" diffuse=".5 .5 .5"/>
    <quality shadowsize="1024"/>
  </visual>
  <asset>
    <texture name="sky" type="skybox" builtin="flat" rgb1="1 1 1" rgb2="1 1 1" width="8" height="8"/>
  </asset>
  <worldbody>
    <light pos="0 0 4" dir="0 0 -1" directional="true" diffuse=".4 .4 .4"/>
    <geom type="cylinder" size="{radius} .002" rgba=".82 .82 .8 1"/>
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
    camera.lookat[:] = (0, 0, 0.35 * trajectory.arena_height)
    camera.distance, camera.azimuth, camera.elevation = 3.2 * trajectory.arena_radius / 0.9, 90, -58
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
            frames.append(renderer.render().copy())
    return frames


def _colored(geoms, color):
    return geoms.replace("/>", f' rgba="{color}"/>')


if __name__ == "__main__":
    write_gif(Path(sys.argv[2]), render(Trajectory.load(Path(sys.argv[1]))))
