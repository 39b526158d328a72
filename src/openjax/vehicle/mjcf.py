"""The MJCF of a vehicle: read by MuJoCo, and checked as strictly as the numbers of a
`vehicle.toml` are.
"""

from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated
from xml.etree import ElementTree

import mujoco
import numpy as np

from openjax.errors import UserError
from openjax.files import LARGEST_TEXT
from openjax.ranges import Interval, check_intervals

ROTORS = ("rotor_1", "rotor_2", "rotor_3", "rotor_4")
BODY = "crazyflie"
QUADRANTS = np.array([[1, -1], [-1, -1], [-1, 1], [1, 1]])
"""Signs of x and y of each rotor's place: front right, rear right, rear left, front
left.
"""
MOST_COPIES = 1_000
"""Of a part that `count` repeats; within each other they multiply."""
MOST_CELLS = 10_000_000
"""Of a texture or a height field: no scene needs more."""
Three = tuple[float, float, float]


@dataclass(frozen=True)
class _Numbers:
    """The content of a vehicle's MJCF, with its ranges."""

    mass: Annotated[float, Interval("[0.005, 10]", "kg")]
    """As in a vehicle.toml."""
    inertia: Annotated[Three, Interval("(0, 10]", "kg m^2")]
    gravity: Annotated[float, Interval("[0.1, 100]", "m/s^2")]
    """Downwards."""
    torque_per_thrust: Annotated[float, Interval("[1e-6, 1]", "m")]
    thrust_constant: Annotated[float, Interval("(0, 1]", "N s^2")]
    max_rotor_speed: Annotated[float, Interval("(0, 1e5]", "rad/s")]
    motor_time_constant: Annotated[float, Interval("[1e-4, 10]", "s")]
    """Of no lag at all no step is short enough."""
    rate_kp: Annotated[Three, Interval("[0, 1e6]")]
    rate_ki: Annotated[Three, Interval("[0, 1e6]")]
    rate_kd: Annotated[Three, Interval("[0, 1e6]")]
    rate_integral_limit: Annotated[Three, Interval("[0, 1e6]", "deg")]


_CUSTOM = {
    "thrust_constant": 1,
    "max_rotor_speed": 1,
    "motor_time_constant": 1,
    "rate_kp": 3,
    "rate_ki": 3,
    "rate_kd": 3,
    "rate_integral_limit": 3,
}
"""Entries of an MJCF's `<custom>`, with their number of values."""


@lru_cache(maxsize=8)
def read_mjcf(path: str) -> dict[str, np.ndarray]:
    """Field of `Vehicle` -> float64 value, from the compiled model at `path`.

    Raises:
      UserError: the file isn't MJCF, lacks something that a vehicle needs, or holds a
      number that no vehicle has.
    """
    _check_size(Path(path), set())
    try:
        model = mujoco.MjModel.from_xml_path(path)
    except (ValueError, OSError) as error:
        raise UserError(
            f"{path}: not a readable MJCF model ({str(error).splitlines()[0]})"
        ) from None
    body = _find(model, path, "body", BODY)
    # all equations here are about the centre of mass and the principal axes
    is_turned = not np.allclose(model.body_iquat[body], [1, 0, 0, 0])
    if is_turned or not np.allclose(model.body_ipos[body], 0):
        raise UserError(
            f"{path}: the inertial frame of {BODY!r} must lie in the body frame (pos 0, "
            "diaginertia only)"
        )
    if model.opt.gravity[:2].any():
        raise UserError(f"{path}: gravity is {model.opt.gravity.tolist()}; it must point along -z")
    position, torque_per_thrust = _rotors(model, path, body)
    custom = {name: _number(model, path, name, size) for name, size in _CUSTOM.items()}
    numbers = _Numbers(
        mass=float(model.body_mass[body]),
        inertia=tuple(model.body_inertia[body].tolist()),
        gravity=float(-model.opt.gravity[2]),
        torque_per_thrust=float(np.abs(torque_per_thrust).mean()),
        **custom,
    )
    check_intervals(numbers, f"{path}: ")
    fields = {name: np.array(value) for name, value in asdict(numbers).items()}
    ratio = fields.pop("torque_per_thrust")
    return {
        **fields,
        "rotor_position": position,
        "rotor_spin": np.sign(torque_per_thrust),
        "torque_constant": ratio * numbers.thrust_constant,
        "motor_slowdown_ratio": np.float64(1.0),
    }


def _rotors(model, path, body) -> tuple[np.ndarray, np.ndarray]:
    """The rotors' positions (4, 3) m, and their torque about z per thrust (4,) m, signed by their
    spin. Raises UserError for rotors that don't push up from the four corners.
    """
    actuators = [_find(model, path, "actuator", name) for name in ROTORS]
    sites = [_find(model, path, "site", name) for name in ROTORS]
    gears = model.actuator_gear[actuators]
    position = model.site_pos[sites]
    for name, actuator, site, gear, place, quadrant in zip(
        ROTORS, actuators, sites, gears, position, QUADRANTS, strict=True
    ):
        turned = np.zeros(3)
        mujoco.mju_rotVecQuat(turned, np.array([0.0, 0.0, 1.0]), model.site_quat[site])
        if model.actuator_trnid[actuator, 0] != site or model.site_bodyid[site] != body:
            raise UserError(f"{path}: actuator {name!r} must act on site {name!r} of {BODY!r}")
        if not (np.allclose(gear[:5], [0, 0, 1, 0, 0]) and np.allclose(turned, [0, 0, 1])):
            raise UserError(
                f"{path}: {name!r} must push along +z of {BODY!r}: a site that isn't turned, and "
                "gear = 0 0 1 0 0 and the torque per thrust"
            )
        if not (np.sign(place[:2]) == quadrant).all() or not np.abs(place).max() < 10.0:
            raise UserError(
                f"{path}: {name!r} is at {place.tolist()} m; x must be {'-0+'[quadrant[0] + 1]} "
                f"and y {'-0+'[quadrant[1] + 1]} there: front right, rear right, rear left, "
                "front left"
            )
    spins = np.sign(gears[:, 5])
    if sorted(spins.tolist()) != [-1.0, -1.0, 1.0, 1.0]:
        raise UserError(
            f"{path}: torques per thrust are {gears[:, 5].tolist()}; two must be positive and two "
            "negative"
        )
    return position, gears[:, 5]


def _check_size(path: Path, read: set[Path]) -> None:
    """Raises UserError for a model that takes the memory of a machine: what is repeated
    is counted before MuJoCo makes it. What isn't XML is left to MuJoCo.
    """
    if path in read or not path.is_file():
        return
    read.add(path)
    if path.stat().st_size > LARGEST_TEXT:
        raise UserError(f"{path}: {path.stat().st_size} bytes are too many for an MJCF")
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, OSError, ValueError, LookupError):
        return
    level = [(root, 1.0)]
    while level:
        element, copies = level.pop()
        copies *= _product(element, "count")
        cells = _product(element, "width", "height", "nrow", "ncol")
        if not (copies <= MOST_COPIES and cells <= MOST_CELLS):
            what = f"{copies:.0e} copies" if cells <= MOST_CELLS else f"{cells:.0e} cells"
            raise UserError(f"{path}: <{element.tag}> asks for {what}, which no vehicle needs")
        if element.tag == "include":
            _check_size(path.parent / element.get("file", ""), read)
        level += [(child, copies) for child in element]


def _product(element, *names: str) -> float:
    """Of all numbers in these attributes; 1 where there are none."""
    product = 1.0
    for text in " ".join(element.get(name, "") for name in names).split():
        try:
            product *= max(float(text), 1.0)
        except ValueError:
            continue
    return product


def _find(model, path, kind, name):
    """The index of a named part of a model. Raises UserError where it has none."""
    index = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
    if index < 0:
        raise UserError(f"{path}: has no {kind} named {name!r}, which a vehicle needs")
    return index


def _number(model, path, name, size):
    """The values of a `numeric`: a number, or a tuple of `size`."""
    index = _find(model, path, "numeric", name)
    start = model.numeric_adr[index]
    count = model.numeric_size[index]
    if count != size:
        raise UserError(f"{path}: numeric {name!r} holds {count} values, {size} would be right")
    values = model.numeric_data[start : start + count].tolist()
    return values[0] if size == 1 else tuple(values)
