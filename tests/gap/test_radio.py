"""What a link did to the commands, read from logs whose motors are sampled every 2 ms,
as `openjax.fly` writes them.
"""

from types import SimpleNamespace

import numpy as np
import pytest

from openjax.flights.flight import Flight
from openjax.flights.grid import flight_tracks
from openjax.gap.channels.radio import read_radio
from openjax.gap.model.library import library

BOTH = ("command_latency", "packet_loss")
CASE = SimpleNamespace(
    vehicle_file=SimpleNamespace(motor=SimpleNamespace(command="thrust"), log={}),
    others=lambda flight: (),
    vehicle_of=lambda flight: None,
)


def flown(latency, loss, jitter=0.0005, phase=0.004, seed=0, seconds=16.0):
    """Tracks of a log: commands every 10 ms from `phase` on, late by a half-normal
    jitter (s), arriving `latency` later or never; and the share that never did.
    """
    rng = np.random.default_rng(seed)
    number = int(100 * seconds)
    sent = 0.01 * np.arange(number) + phase + np.abs(rng.normal(0.0, jitter, number))
    thrust = np.full(number, 0.45)
    for k in range(1, number):
        thrust[k] = 0.45 + 0.9 * (thrust[k - 1] - 0.45) + 0.02 * rng.standard_normal()
    arrived = rng.random(number) >= loss
    arrived[0] = True
    time = np.arange(0.0207, seconds - 0.02, 0.002) + latency
    commanded = np.searchsorted(sent, time, side="right") - 1
    held = np.flatnonzero(arrived)[np.searchsorted(sent[arrived] + latency, time, side="right") - 1]
    rates = np.stack([np.sin(5 * time), np.cos(4 * time), 0 * time], 1)
    apart = 0.01 * np.array([1, -1, 1, -1]) * np.sin(20 * time)[:, None]
    flight = Flight(
        "flight",
        "flight",
        "0",
        time,
        body_rates=rates,
        command_thrust=thrust[commanded],
        command_body_rates=rates,
        motor_command=np.round((thrust[held][:, None] + apart) * 65535) / 65535,
    )
    return flight_tracks(flight, CASE), 1.0 - arrived.mean()


@pytest.mark.parametrize("phase", [0.0, 0.004, 0.007])
@pytest.mark.parametrize(("latency", "loss"), [(0.0, 0.05), (0.0, 0.2), (0.012, 0.05), (0.02, 0.1)])
def test_a_loss_is_told_alone_and_beside_a_latency(latency, loss, phase):
    tracks, lost = flown(latency, loss, phase=phase)
    radio = read_radio(tracks, library())
    assert tuple(radio.acting()) == (BOTH if latency else BOTH[1:])
    assert radio.loss == pytest.approx(lost, abs=0.03)
    assert radio.delay == pytest.approx(latency, abs=0.001)


@pytest.mark.parametrize(
    ("latency", "jitter"), [(0.0, 0.0005), (0.006, 0.001), (0.012, 0.003), (0.02, 0.0005)]
)
def test_a_latency_that_jitters_is_no_loss(latency, jitter):
    radio = read_radio(flown(latency, 0.0, jitter)[0], library())
    assert "packet_loss" not in radio.acting()


def test_rows_begin_where_commands_do():
    (track,), _ = flown(0.0, 0.0, jitter=1e-5)
    changed = np.diff(track.command[:, 0]) != 0.0
    assert changed.mean() > 0.98
    assert (
        np.abs(track.motor.mean(1) - track.command[:, 0]).max() < 1e-4
    )  # no row mixes two commands
