"""Manoeuvres of the sample flights: where vehicles are to be, row by row."""

from dataclasses import dataclass

import numpy as np

PERIOD = 0.01  # s, rows and off-board commands


@dataclass(frozen=True)
class Reference:
    """The reference that N vehicles are to fly, T rows at the row period."""

    position: np.ndarray  # (T, N, 3) m
    yaw: np.ndarray  # (T, N) rad
    extra_command: np.ndarray
    """(T, N, 4) thrust in 0..1, body rates in rad/s, added to the controller's."""
    open_circuit_voltage: float = 3.9  # V at the start


def references(
    seed: int = 0, duration: float = 10.0, neighbour: bool = False
) -> dict[str, Reference]:
    """Three flights that expose a vehicle: waypoints down to 6 cm above the floor and near 1.1 m, a
    fast Lissajous figure with turning yaw, and doublets on every axis around hover, from a full to
    a low battery. With `neighbour` a second vehicle sweeps back and forth 35 to 55 cm above.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, duration, PERIOD)
    zero = np.zeros((len(t), 4))
    hover = np.tile([0.0, 0.0, 0.7], (len(t), 1))
    # in this order: a seed's draws are those of the way points, then of the figure
    flights = {
        "flight_a": (_way_points(rng, t, duration), 0.6 * np.sin(0.9 * t), zero, 4.1),
        "flight_b": (_figure(rng, t), 0.8 * np.sin(0.7 * t), zero, 3.9),
        "flight_c": (hover, 0.0 * t, _doublets(t, duration), 3.7),
    }
    sideways = 0.25 * np.sin(1.3 * t)
    along = 0.1 * np.sin(0.8 * t)
    above = 0.45 + 0.1 * np.sin(0.5 * t)
    offset = np.stack([sideways, along, above], 1)
    by_name = {}
    for name, (place, yaw, command, voltage) in flights.items():
        places = [place]
        yaws = [yaw]
        commands = [command]
        if neighbour:
            places.append(place + offset)
            yaws.append(0 * yaw)
            commands.append(zero)
        by_name[name] = Reference(
            position=np.stack(places, 1),
            yaw=np.stack(yaws, 1),
            extra_command=np.stack(commands, 1),
            open_circuit_voltage=voltage,
        )
    return by_name


def _way_points(rng, t, duration):
    """(T, 3) m, from corner to corner."""
    leg = 1.6  # s
    corners = rng.uniform([-0.6, -0.6, 0.3], [0.6, 0.6, 1.0], (int(duration / leg) + 2, 3))
    # one of three is near the floor and one near the ceiling, whose effects it shows
    corners[3::3, 2] = rng.uniform(0.06, 0.1, len(corners[3::3]))
    corners[2::3, 2] = rng.uniform(1.05, 1.12, len(corners[2::3]))
    return _minimum_jerk(corners, t, leg)


def _figure(rng, t):
    """(T, 3) m, a Lissajous figure about the middle."""
    phase = rng.uniform(0, 2 * np.pi, 3)
    frequency = np.array([0.42, 0.35, 0.25]) * 2 * np.pi * rng.uniform(0.9, 1.1, 3)
    start = np.clip(t / 3.0, 0, 1)[:, None]
    # a smooth step, so that the figure begins at rest in the middle
    swell = start**2 * (3 - 2 * start)
    figure = swell * [0.55, 0.55, 0.22] * np.sin(frequency * t[:, None] + phase)
    figure += [0.0, 0.0, 0.6]
    return figure


def _doublets(t, duration):
    """(T, 4) of thrust and rates, one axis after the other, up and down and then the
    other way round.
    """
    doublets = np.zeros((len(t), 4))
    size = np.array([0.12, 4.0, 4.0, 3.0])
    for k, begin in enumerate(np.arange(0.8, duration - 0.6, 0.45)):
        axis = k % 4
        sign = 1 if (k // 4) % 2 == 0 else -1
        at = (t >= begin) & (t < begin + 0.16)
        doublets[at, axis] += sign * size[axis] * np.where(t[at] < begin + 0.08, 1.0, -1.0)
    return doublets


def _minimum_jerk(points: np.ndarray, t: np.ndarray, leg: float) -> np.ndarray:
    """Positions (T, 3) along legs of `leg` seconds between points, at rest at each (10
    s^3 - 15 s^4 + 6 s^5).
    """
    k = np.minimum((t / leg).astype(int), len(points) - 2)
    s = np.clip(t / leg - k, 0.0, 1.0)[:, None]
    return points[k] + (points[k + 1] - points[k]) * s**3 * (10 - 15 * s + 6 * s**2)
