"""What the table of shares counts as unavoidable."""

import jax
import jax.numpy as jnp
import pytest

from openjax.commands.step_shares import ARITHMETIC, BANDWIDTH, Share, products
from openjax.learning import preset

F, HEADS, OTHERS, PILLARS = 128, 2, 2, 3


def test_products_of_a_sample_are_those_of_the_folded_attention():
    def matrix(*shape):
        return jax.ShapeDtypeStruct(shape, jnp.float32)

    attention = {name: matrix(F, F) for name in ("query", "key", "value", "output")}
    attention |= {"others_kernel": matrix(3, F), "pillars_kernel": matrix(5, F), "others_bias": matrix(1, F)}
    encoder = {"self_1": {"kernel": matrix(40, F), "affine": matrix(3, F)}, "attention": attention}
    by_hand = 40 * F + 2 * HEADS * F * F + OTHERS * 3 * F + PILLARS * 5 * F
    by_hand += 2 * HEADS * (1 + OTHERS + PILLARS) * F  # scores and means
    assert products(preset("paper"), {"params": {"encoder": encoder}}) == by_hand


def test_a_critic_of_layers_attends_to_nothing():
    layers = {"layer_1": {"kernel": jax.ShapeDtypeStruct((72, 2 * F), jnp.float32)}}
    assert products(preset("paper"), {"params": layers}) == 72 * 2 * F


def test_the_limit_is_what_takes_longer():
    assert Share("x", 1.0, flops=ARITHMETIC, bytes=BANDWIDTH / 2).limit == pytest.approx(1.0)
    assert Share("x", 1.0, flops=0.0, bytes=2 * BANDWIDTH).limit == pytest.approx(2.0)
