"""On-board estimators: as sure of themselves as they are right, and their logs are flights that the loader takes."""

import numpy as np
import pytest

from experiments.diagnosis import onboard
from openjax.flights import load_case

STEP, RATE = 0.002, 100.0


def flown(estimate, rng, seconds=6.0, accel=0.2, gyro=0.01):
    """Let an estimator follow a swaying body; returns errors (n, 9) of position, body velocity and attitude, and its
    deviations (n, 9)."""
    q, position, velocity = np.array([1.0, 0, 0, 0]), np.zeros(3), np.zeros(3)
    errors, sure = [], []
    for s in range(int(seconds / STEP)):
        t = STEP * s
        rates = np.array([1.5 * np.cos(4 * t), 1.2 * np.sin(3 * t), 0.8 * np.cos(2 * t)])
        push = np.array([2.0 * np.cos(3 * t), -1.5 * np.sin(2 * t), 1.0 * np.sin(5 * t)])
        specific = onboard.matrix_of(q).T @ (push + onboard.GRAVITY)
        if s % round(1 / (RATE * STEP)) == 0:
            estimate.see("position", position + 0.003 * rng.standard_normal(3), 0.003)
            estimate.see("attitude", onboard.turned(q, 0.02 * rng.standard_normal(3)), 0.02)
        r = onboard.matrix_of(q)
        off = onboard.angle_between(estimate.attitude, q)
        errors.append(np.concatenate([position - estimate.position, r.T @ velocity - estimate.v, off]))
        sure.append(np.sqrt(np.diag(estimate.p)))
        estimate.predict(
            specific + accel * rng.standard_normal(3), rates + gyro * rng.standard_normal(3), STEP
        )
        position = position + STEP * velocity + 0.5 * STEP**2 * push
        velocity, q = velocity + STEP * push, onboard.turned(q, STEP * rates)
    return np.array(errors), np.array(sure)


def test_the_kalman_filter_errs_by_what_its_covariance_says():
    ratios = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        root = np.sqrt(STEP)
        e, d = flown(onboard.Kalman(np.zeros(3), np.array([1.0, 0, 0, 0]), 0.2 * root, 0.01 * root), rng)
        ratios.append(((e[500:] / d[500:]) ** 2).mean(0).reshape(3, 3).mean(1))
    normalized = np.mean(ratios, 0)  # 1 for position, velocity and attitude of a consistent filter
    assert np.all(normalized > 0.6)
    assert np.all(normalized < 1.6)


def test_the_complementary_filter_takes_a_steady_push_for_the_plumb_line():
    estimate = onboard.Complementary(np.zeros(3), np.array([1.0, 0, 0, 0]), plumb=2.0, follow=8.0)
    push = np.array([2.0, 0.0, 0.0])
    for _ in range(2000):
        estimate.predict(push + onboard.GRAVITY, np.zeros(3), STEP)
    felt = (push + onboard.GRAVITY) / np.linalg.norm(push + onboard.GRAVITY)
    assert onboard.matrix_of(estimate.attitude)[2] == pytest.approx(felt, abs=1e-3)


def test_a_case_flown_on_its_estimate_is_a_case_for_the_loader(tmp_path, monkeypatch):
    pytest.importorskip("rotorpy")
    from experiments.diagnosis import onboard_cases

    monkeypatch.setattr(onboard_cases, "SECONDS", 4.0)
    monkeypatch.setattr(onboard_cases, "RATES", {100: 1.0})
    answer = onboard_cases.make_case((1, 1, "pulses", tmp_path))
    case = load_case(tmp_path / answer["case"])
    assert len(case.flights) == 3
    assert not [i for i in case.quality if i.refused]
    flight = case.flights[0]
    gap = np.abs(np.gradient(flight.position, flight.time, axis=0) - flight.velocity)[50:-50]
    assert gap.max() < 1.0  # an estimate's velocity is near its position's slope, though not equal
    assert gap.mean() > 1e-3
