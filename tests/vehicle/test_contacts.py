"""The written-out contacts of `rigid` against MuJoCo C on the same model, over random
crashes.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.vehicle.crashes import KINDS, PILLARS, by_mujoco, crashes, flown


@pytest.fixture(scope="module")
def flights():
    with jax.enable_x64(True):
        *start, kind = crashes(400, 0)
        exact, free = flown(start, jnp.float64)
        reference = by_mujoco(start, free)
    return start, kind, exact, flown(start, jnp.float32)[0], reference


@pytest.mark.parametrize(("precision", "tolerance"), [("float64", 1e-8), ("float32", 1e-4)])
def test_a_tenth_of_a_second_of_crashes(flights, precision, tolerance):
    _, _, exact, rounded, (position, velocity, _) = flights
    got = exact if precision == "float64" else rounded
    np.testing.assert_allclose(got[0], position, rtol=0, atol=tolerance)
    np.testing.assert_allclose(got[1], velocity, rtol=0, atol=tolerance)


def test_the_crashes_are_crashes_of_every_kind(flights):
    _, kind, _, _, (_, _, touched) = flights
    floor = touched[..., 0]
    pillar = touched[..., 1 : 1 + PILLARS]
    other = touched[..., 1 + PILLARS :]
    anything = touched.any((1, 2, 3))
    assert all(anything[kind == k].mean() > 0.6 for k in range(4)), KINDS
    assert (
        floor[kind == 0].any((1, 2)).mean() > 0.9 and other[kind == 2].any((1, 2, 3)).mean() > 0.5
    )
    assert (floor[..., None] & pillar).any((1, 2, 3))[kind == 3].mean() > 0.1, "both at once"
