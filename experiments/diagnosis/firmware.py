"""The firmware's rate loop at 500 Hz: filters of gyroscope and derivative, PID in counts, mixer.

Arrays have the body index last.
"""

import numpy as np

from experiments.diagnosis import vehicle

SAMPLE = 0.002
"""Seconds between two steps of the rate loop, at which the truth is kept, too."""


class Filter:
    """Second-order Butterworth low-pass of (n, B) signals at 500 Hz; `cut` (B,) Hz, 0 lets
    everything through.
    """

    def __init__(self, cut, rows, start):
        on = cut > 0
        k = np.tan(np.pi * np.where(on, cut, 1.0) * SAMPLE)
        scale = 1.0 / (1.0 + np.sqrt(2.0) * k + k * k)
        self.b0 = np.where(on, k * k * scale, 1.0)
        self.b1, self.b2 = (np.where(on, c * k * k * scale, 0.0) for c in (2, 1))
        self.a1 = np.where(on, 2 * (k * k - 1) * scale, 0.0)
        self.a2 = np.where(on, (1 - np.sqrt(2.0) * k + k * k) * scale, 0.0)
        self.any = bool(on.any())
        self.one = np.broadcast_to(start, (rows, len(cut))) * (1 - self.b0)
        self.two = np.broadcast_to(start, (rows, len(cut))) * (self.b2 - self.a2)

    def __call__(self, x):
        if not self.any:
            return x
        y = self.b0 * x + self.one
        self.one = self.b1 * x - self.a1 * y + self.two
        self.two = self.b2 * x - self.a2 * y
        return y


class Firmware:
    """Rate loop of the firmware at 500 Hz: filters of gyroscope and derivative, PID in counts,
    mixer.
    """

    def __init__(self, p, gyro, integral=None):
        self.p = p
        count = gyro.shape[1]
        self.limit = vehicle.INTEGRAL_LIMIT[:, None]
        self.integral = np.zeros((3, count)) if integral is None else integral.copy()
        self.gyro_filter = Filter(p["gyro_cut"], 3, gyro)
        self.slope_filter = Filter(p["derivative_cut"], 3, 0.0)
        self.keep = np.where(
            p["d_filter"] > 0, np.exp(-SAMPLE / np.maximum(p["d_filter"], 1e-6)), 0.0
        )
        self.slow = bool(self.keep.any())
        self.previous, self.slope = gyro.copy(), np.zeros((3, count))

    def __call__(self, command, gyro):
        """Motor commands (4, B) from the command in force (4, B) and the filtered gyroscope (3, B)."""
        p = self.p
        error = np.rad2deg(command[1:] - gyro)
        self.integral = np.minimum(
            np.maximum(self.integral + SAMPLE * error, -self.limit), self.limit
        )
        slope = self.slope_filter(np.rad2deg(self.previous - gyro) / SAMPLE)
        self.slope = self.keep * self.slope + (1 - self.keep) * slope if self.slow else slope
        self.previous = gyro
        return vehicle.mix(
            command[0], p["kp"] * error + p["ki"] * self.integral + p["kd"] * self.slope
        )
