"""Causes outside the vocabulary, drawn by a generator: thousands of kinds, so that none can be
written a detector for.

A kind is a site (a force, a torque, the motors, a sensor) and a function f of a random subset of
place, motion, motors, voltage and time: a sum of random Fourier features (Rahimi, Recht 2007)
without its mean and its linear part, as far as the inputs are normally distributed. What is left
can't be taken over by a constant or a line in any input, which the vocabulary's effects are. It
sets in at a random time. The `switching` form, for reported runs alone, is the sign of such a sum:
knocks, relays, steps. Everything follows from the eight uniform draws of the cause.
"""

from typing import NamedTuple

import numpy as np

from experiments.diagnosis.vehicle import multiply, rotate_back


class Site(NamedTuple):
    """Where a kind acts: (smallest, largest) root mean square, its unit, whether in the logs alone."""

    sizes: tuple
    unit: str
    logs: str = ""  # channel of the log that is off


SITES = {
    "unknown_force": Site((2.0, 60.0), "mN"),
    "unknown_torque": Site((0.01, 0.3), "mN m"),
    "unknown_motors": Site((0.01, 0.2), "of the thrust"),
    "unknown_gyroscope": Site((0.05, 0.6), "rad/s", "g"),
    "unknown_accelerometer": Site((0.3, 3.0), "m/s^2", "a"),
    "unknown_position": Site((0.003, 0.04), "m", "p"),
    "unknown_attitude": Site((0.01, 0.1), "rad", "p"),
}
SENSOR_SITES = tuple(name for name, site in SITES.items() if site.logs)
FORMS = {"known": "smooth", "stranger": "switching"}
MISSIONS = ("agile", "fast", "step", "laps", "climb", "yaw")
FEATURES = 6
# Inputs: name -> (number of values, the size of one that is usual in flight)
INPUTS = {
    "place": (3, 0.3),  # m
    # body velocity m/s, body rates rad/s
    "motion": (6, (0.6, 0.6, 0.4, 1.2, 1.2, 1.0)),
    "motors": (4, 0.08),  # of the command, about hover
    "voltage": (1, 0.1),  # V, about 3.7
    "time": (1, 1.0),  # s
}
SCALE = np.concatenate([np.broadcast_to(size, count) for count, size in INPUTS.values()])
SLOWEST, FASTEST = 0.3, 4.0  # Hz, of a kind that time has a part in


class Generated:
    """The functions of some bodies' causes: calls give values (n,) with a root mean square of about
    one.
    """

    def __init__(self, causes):
        """causes: n dicts with `shape` and `form`."""
        drawn = [self._draw(cause) for cause in causes]
        (
            self.waves,
            self.phases,
            self.onset,
            self.axis,
            self.rotors,
            self.mean,
            self.slope,
            self.world,
        ) = (np.stack(part, axis=-1) for part in zip(*drawn, strict=True))
        self.switching = np.array([cause["form"] == "switching" for cause in causes])

    @staticmethod
    def _draw(cause):
        rng = np.random.default_rng((1e9 * np.asarray(cause["shape"])).astype(np.uint32))
        names = list(INPUTS)
        chosen = set(rng.choice(names, size=rng.integers(1, 4), replace=False))
        if chosen == {"voltage"}:  # hardly moves within a flight
            chosen.add("motors")
        waves = rng.standard_normal((FEATURES, len(SCALE)))
        waves *= np.concatenate([np.full(INPUTS[n][0], n in chosen) for n in names])
        still = waves[:, :-1]
        still *= rng.uniform(1.5, 3.0) / np.maximum(
            np.linalg.norm(still, axis=1, keepdims=True), 1e-9
        )
        if "time" in chosen:
            turns = SLOWEST * (FASTEST / SLOWEST) ** rng.uniform(size=FEATURES)
            waves[:, -1] = 2 * np.pi * turns * rng.choice([-1, 1], FEATURES)
        phases = rng.uniform(0, 2 * np.pi, FEATURES)
        fall = np.exp(-0.5 * (waves**2).sum(1))
        mean = (np.cos(phases) * fall).sum()
        slope = -(waves * (np.sin(phases) * fall)[:, None]).sum(0)
        onset = rng.uniform(1.5, 5.0) if rng.random() < 0.4 else 0.0
        axis = rng.standard_normal(3)
        rotors = rng.permutation([1.0, *rng.choice([0.0, 1.0, -1.0], 3)])
        return (
            waves,
            phases,
            onset,
            axis / np.linalg.norm(axis),
            rotors,
            mean,
            slope,
            rng.random() < 0.5,
        )

    def __call__(self, inputs, time):
        """Values (n,) at inputs (14, n), of which the last row is replaced by the time since the
        onset.
        """
        x = np.concatenate([inputs, np.broadcast_to(time - self.onset, (1, inputs.shape[1]))])
        waves = np.cos(np.einsum("fin,in->fn", self.waves, x) + self.phases).sum(0)
        smooth = (waves - self.mean - (self.slope * x).sum(0)) * np.sqrt(2.0 / FEATURES)
        value = np.where(self.switching, np.sign(waves - self.mean), smooth)
        return np.where(time >= self.onset, value, 0.0)


def inputs_of(position, q, velocity, rates, motors, voltage, hover):
    """(14, n) what the functions depend on, each about normally distributed: positions, velocities
    and rates (3, n), q and motors (4, n), voltage and hover command (n,).
    """
    middle = position - np.array([[0.0], [0.0], [0.6]])
    rows = [middle, rotate_back(q, velocity), rates, motors - hover, voltage[None] - 3.7]
    return np.concatenate(rows) / SCALE[:-1, None]


class Unknowns:
    """The unknown causes of a batch of `count` bodies: {site: [(columns, cause), …]}."""

    def __init__(self, causes, count, hover=0.5):
        self.count = count
        self.hover = hover
        self.inputs = None
        self.sites = {}
        for site, entries in causes.items():
            if site in SENSOR_SITES or not entries:
                continue
            columns = np.concatenate([c for c, _ in entries])
            each = [cause for c, cause in entries for _ in np.atleast_1d(c)]
            size = np.array([cause["size"] for cause in each])
            self.sites[site] = columns, Generated(each), size

    def __bool__(self):
        return bool(self.sites)

    def look(self, position, q, velocity, rates, motors, voltage):
        """What the bodies do in this step; before `motors` and `wrench`."""
        self.inputs = inputs_of(position, q, velocity, rates, motors, voltage, self.hover)

    def _values(self, site, time):
        columns, function, size = self.sites[site]
        return columns, function, size * function(self.inputs[:, columns], time)

    def motors(self, u, time):
        """Effective thrust fraction (4, B) after causes that sit in the motors."""
        if "unknown_motors" not in self.sites:
            return u
        columns, function, values = self._values("unknown_motors", time)
        out = u.copy()
        out[:, columns] *= np.maximum(1.0 + function.rotors * values, 0.0)
        return out

    def wrench(self, q, time):
        """Force (3, B) N and torque (3, B) N m in the body frame."""
        force = np.zeros((3, self.count))
        torque = np.zeros((3, self.count))
        if "unknown_force" in self.sites:
            columns, function, values = self._values("unknown_force", time)
            push = 1e-3 * function.axis * values
            force[:, columns] = np.where(function.world, rotate_back(q[:, columns], push), push)
        if "unknown_torque" in self.sites:
            columns, function, values = self._values("unknown_torque", time)
            torque[:, columns] = 1e-3 * function.axis * values
        return force, torque


def misread(causes, inputs, times):
    """{site: (n, 3)} by how much the sensors of one body are off at `times` (n,); `inputs` (14, n)."""
    out = {}
    for cause in causes:
        function = Generated([cause])
        values = np.array([function(inputs[:, k : k + 1], t)[0] for k, t in enumerate(times)])
        out[cause["effect"]] = cause["size"] * values[:, None] * function.axis[:, 0]
    return out


def turned(q, angle):
    """Attitudes q (n, 4) turned by small rotation vectors (n, 3) in the world."""
    half = np.concatenate([np.ones((len(q), 1)), 0.5 * angle], axis=1).T
    out = multiply(half, q.T).T
    return out / np.linalg.norm(out, axis=1, keepdims=True)
