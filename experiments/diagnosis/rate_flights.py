"""Flights of body rates alone, with known truth: what an identification of the torques is tried on.

A rate loop at 500 Hz (the firmware's gains) around rigid-body rates at 1 kHz, in NumPy, many
flights at once. Commands wander; a coloured torque pushes (gusts); the gyroscope is noisy. Nothing
of it is openjax' code.
"""

from dataclasses import dataclass

import numpy as np

STEP = 0.001  # s
TICK = 0.002  # s
ARM = 0.0325  # m, of each rotor along x and y
INERTIA = np.array([1.4e-5, 1.4e-5, 2.17e-5])  # kg m^2
LARGEST = 0.12597  # N, of one rotor
TORQUE_PER_THRUST = 0.025  # m
PLACES = ARM * np.array([[1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0], [1.0, 1.0]])
SPIN = np.array([-1.0, 1.0, -1.0, 1.0])
COUNTS = np.rad2deg(1.0) / 65536.0
GAINS = [COUNTS * np.array(g)[:, None] for g in ([250, 250, 120], [500, 500, 16.7], [2.5, 2.5, 0])]
HOVER = 0.62  # of the largest thrust
COMMANDS = 2.0  # rad/s
GYROSCOPE = 0.02  # rad/s
GUSTY = 3.0  # Hz, bandwidth of the gusts' torque
TRIM = 0.01  # of a rotor's thrust


@dataclass(frozen=True)
class Truth:
    """One flight's vehicle and air. Lags and delay in s; `inertia` and `yaw` as multiples;
    `damping` 1/s; `gust` rad/s^2.
    """

    up: float = 0.025
    down: float = 0.025
    delay: float = 0.0
    inertia: float = 1.0
    yaw: float = 1.0
    damping: float = 0.0
    gust: float = 3.0
    seed: int = 0


class Plant:
    """Rotors and rates (3, B) of B vehicles in their air."""

    def __init__(self, truths: list[Truth], trims: np.ndarray):
        def of(name):
            return np.array([getattr(t, name) for t in truths], float)

        self.inertia = INERTIA[:, None] * of("inertia")
        self.torque = LARGEST * np.stack([PLACES[:, 1], -PLACES[:, 0], TORQUE_PER_THRUST * SPIN])
        self.trims = trims
        self.faster = -np.expm1(-STEP / of("up"))
        self.slower = -np.expm1(-STEP / of("down"))
        self.late = np.round(of("delay") / STEP).astype(int)
        self.yaw = of("yaw")
        self.damping = of("damping")
        self.kept = np.exp(-2.0 * np.pi * GUSTY * STEP)
        self.push = of("gust") * np.sqrt(1.0 - self.kept**2)
        self.every = np.arange(len(truths))
        self.sent = np.full((self.late.max() + 1, 4, len(truths)), HOVER)
        self.rates = np.zeros((3, len(truths)))
        self.air = np.zeros((3, len(truths)))
        self.speed = np.full((4, len(truths)), np.sqrt(HOVER))
        self.steps = 0

    def step(self, motors: np.ndarray, gust: np.ndarray):
        """One millisecond under motor commands (4, B); `gust` (3, B) standard normal."""
        size = len(self.sent)
        self.sent[self.steps % size] = motors
        target = np.sqrt(self.sent[(self.steps - self.late) % size, :, self.every].T)
        self.steps += 1
        old = self.speed
        share = np.where(target < old, self.slower, self.faster)
        self.speed = old + (target - old) * share
        square = (old * old + old * self.speed + self.speed * self.speed) / 3.0
        self.air = self.kept * self.air + self.push * gust
        pull = self.torque @ (square * self.trims)
        pull[2] *= self.yaw
        pull -= np.cross(self.rates, self.inertia * self.rates, axis=0)
        self.rates = self.rates + STEP * (
            pull / self.inertia - self.damping * self.rates + self.air
        )


def fly(truths: list[Truth], seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Gyroscope (B, N, 3) rad/s and motor commands (B, N, 4) of every cycle of the rate loop."""
    count = round(seconds / TICK)
    draws = [np.random.default_rng(t.seed) for t in truths]

    def noise(*shape):
        return np.stack([d.normal(size=shape) for d in draws], -1)

    gyroscope = GYROSCOPE * noise(count, 3)
    gusts = noise(count, 2, 3)
    command_steps = noise(count // 5 + 1, 3)
    plant = Plant(truths, 1.0 + TRIM * noise(4))
    mixer = np.stack([0.5 * np.sign(PLACES[:, 1]), -0.5 * np.sign(PLACES[:, 0]), SPIN], 1)
    integral, before, wanted = (np.zeros_like(plant.rates) for _ in range(3))
    seen = np.zeros((count, *plant.rates.shape))
    motors = np.zeros((count, *plant.speed.shape))
    for k in range(count):
        if k % 5 == 0:
            wanted = 0.97 * wanted + COMMANDS * np.sqrt(1.0 - 0.97**2) * command_steps[k // 5]
        phase = 2.0 * np.pi * TICK * k
        thrust = HOVER + 0.05 * np.sin(0.7 * phase) + 0.03 * np.sin(2.3 * phase)
        seen[k] = plant.rates + gyroscope[k]
        error = wanted - seen[k]
        integral = np.clip(integral + TICK * error, -0.58, 0.58)
        output = GAINS[0] * error + GAINS[1] * integral - GAINS[2] * (seen[k] - before) / TICK
        before = seen[k]
        motors[k] = np.clip(thrust + mixer @ output, 0.0, 1.0)
        for half in range(2):
            plant.step(motors[k], gusts[k, half])
    return np.moveaxis(seen, -1, 0), np.moveaxis(motors, -1, 0)


def rows_of(gyroscope: np.ndarray, motors: np.ndarray, rate: int, samples: bool):
    """One flight's rows (T, 3) and (T, 4) at `rate` Hz: motors as means over rows, or `samples`."""
    every = round(1.0 / rate / TICK)
    count = len(motors) // every * every
    rows = motors[:count].reshape(-1, every, 4)
    return gyroscope[:count:every], rows[:, 0] if samples else rows.mean(1)


def vehicle_of(nominal):
    """The nominal vehicle of openjax with this plant's numbers."""
    places = np.concatenate([PLACES, np.zeros((4, 1))], 1)
    scale = nominal.thrust_constant * nominal.max_rotor_speed**2
    return nominal.replace(
        rotor_position=places,
        rotor_spin=SPIN,
        inertia=INERTIA,
        thrust_constant=nominal.thrust_constant * LARGEST / scale,
        torque_constant=nominal.thrust_constant * LARGEST / scale * TORQUE_PER_THRUST,
    )
