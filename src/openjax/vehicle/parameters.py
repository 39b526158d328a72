"""The vehicle's parameters, read from its MJCF: the one source of these numbers."""

from pathlib import Path

import flax.struct
import jax.numpy as jnp

from openjax.errors import UserError, suggestion
from openjax.vehicle.mjcf import read_mjcf
from openjax.vehicle.shapes import Command, Hubs, Rotors, Scalar, Vector

NOMINAL = "crazyflie"
AIRFRAMES: dict[str, str | Path] = {
    NOMINAL: "crazyflie.xml",
    "brushless": "crazyflie_brushless.xml",
}
"""The MJCF of each airframe that settings and vehicle files may name, with its family
beside it: the Crazyflie 2.1 and the Crazyflie 2.1 Brushless, in the package's assets,
and what `register_airframe` put there.
"""


@flax.struct.dataclass
class Vehicle:
    """One vehicle: a pytree of arrays. A copy with replaced leaves is another vehicle.
    Body frame: x forward, y left, z up, origin at the centre of mass.
    """

    mass: Scalar  # kg
    inertia: Vector  # kg m^2, principal, along the body axes
    rotor_position: Hubs
    """m, body frame, m1 front right, m2 rear right, m3 rear left, m4 front left"""
    rotor_spin: Rotors
    """+1: reaction torque on the body along +z (clockwise rotor), -1:
    counter-clockwise
    """
    thrust_constant: Scalar  # N s^2, thrust = thrust_constant * speed^2
    torque_constant: Scalar  # N m s^2, torque = spin * torque_constant * speed^2
    max_rotor_speed: Scalar  # rad/s
    motor_time_constant: Scalar  # s, while the rotor speeds up
    # time constant of slowing down / of speeding up, 1 nominally
    motor_slowdown_ratio: Scalar
    gravity: Scalar  # m/s^2
    rate_kp: Vector  # motor counts per deg/s; roll, pitch, yaw
    rate_ki: Vector  # motor counts per deg
    rate_kd: Vector  # motor counts per deg/s^2
    rate_integral_limit: Vector  # deg


def assets_directory() -> Path:
    """The folder of the MJCF files: inside the installed package, or at the top of the source tree.
    Raises UserError if there is none.
    """
    file = Path(__file__).resolve()
    for candidate in (file.parents[1] / "assets", file.parents[3] / "assets"):
        if (candidate / "crazyflie.xml").is_file():
            return candidate
    raise UserError(
        f"crazyflie.xml is neither in {file.parents[1]}/assets nor in {file.parents[3]}/assets"
    )


def register_airframe(name: str, mjcf: str | Path) -> None:
    """From now on `name` is an airframe: settings, vehicle files and commands of this
    process may name it. A run that was trained with it is resumed by a process that has
    registered it, too.

    Args:
      name: other than that of a shipped one.
      mjcf: its file. Where vehicles are to be drawn from its family, STEM_family.toml
      lies beside it (see `openjax.vehicle.family`).

    Raises:
      UserError: the name is taken by another file, or the file isn't a vehicle.
    """
    path = Path(mjcf).resolve()
    if AIRFRAMES.get(name, path) != path:
        raise UserError(f"airframe {name}: there is one of that name ({AIRFRAMES[name]})")
    read_mjcf(str(path))  # says now what is wrong with it, and not when a game is made
    AIRFRAMES[name] = path


def check_airframe(name: str) -> None:
    """Raises UserError for an airframe that nobody registered."""
    if name not in AIRFRAMES:
        raise UserError(f"airframe {name[:60]}: unknown; {suggestion(name, AIRFRAMES)}")


def find_mjcf(name_or_path: str | Path) -> Path:
    """The MJCF file of an airframe: one of `AIRFRAMES`, or a file. UserError: there is
    none.
    """
    shipped_file = AIRFRAMES.get(str(name_or_path))
    path = Path(name_or_path) if shipped_file is None else assets_directory() / shipped_file
    if not path.is_file():
        raise UserError(f"{path}: no such MJCF file, nor an airframe ({', '.join(AIRFRAMES)})")
    return path


def load_vehicle(airframe: str | Path = NOMINAL, dtype=jnp.float32) -> Vehicle:
    """The vehicle of an airframe: one of `AIRFRAMES`, or an MJCF file.

    Raises:
      UserError: the file is missing, isn't MJCF or lacks a part of a vehicle.
    """
    path = find_mjcf(airframe).resolve()
    numbers = read_mjcf(str(path))
    return Vehicle(**{name: jnp.asarray(value, dtype) for name, value in numbers.items()})


def hover_rotor_speed(vehicle: Vehicle) -> Scalar:
    """Rotor speed at which four level rotors carry the vehicle, () rad/s."""
    return jnp.sqrt(vehicle.mass * vehicle.gravity / (4 * vehicle.thrust_constant))


def max_rotor_thrust(vehicle: Vehicle) -> Scalar:
    """Largest thrust of one rotor, () N."""
    return vehicle.thrust_constant * vehicle.max_rotor_speed**2


def hover_share(vehicle: Vehicle) -> Scalar:
    """Collective thrust that carries the level vehicle, () as a share of the
    largest.
    """
    return vehicle.mass * vehicle.gravity / (4 * max_rotor_thrust(vehicle))


def hover_command(vehicle: Vehicle, dtype=jnp.float32) -> Command:
    """The command that carries the level vehicle and doesn't turn it."""
    return jnp.zeros(4, dtype).at[0].set(hover_share(vehicle))
