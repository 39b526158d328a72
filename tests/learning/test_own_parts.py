"""Networks and learners of one's own that aren't ones: a line says what is wrong."""

import jax
import jax.numpy as jnp
import pytest

from openjax import UserError, make
from openjax.learning.learners.learner import check_learners, check_learning
from openjax.policy import check_network


class Plain:
    """A network of one number."""

    def init(self, key, seen):
        return {"bias": jnp.zeros(4)}, {"bias": jnp.zeros(())}

    def distribution(self, actor, seen):
        shape = (*seen.self_state.shape[:-1], 4)
        return jnp.broadcast_to(actor["bias"], shape), jnp.zeros(4)

    def value(self, critic, seen):
        return jnp.broadcast_to(critic["bias"], seen.self_state.shape[:-1])


class OfOneWorld(Plain):
    def distribution(self, actor, seen):
        return jnp.zeros((3, 4)), jnp.zeros(4)


class WithAnAxisMore(Plain):
    def value(self, critic, seen):
        return super().value(critic, seen)[..., None]


@pytest.fixture(scope="module")
def observation():
    return jax.eval_shape(make().reset, jax.random.key(0))[0]


@pytest.mark.parametrize(
    ("network", "words"),
    [
        (object(), "init, distribution and value are needed"),
        (Plain, "a class; an object of it"),
        (OfOneWorld(), r"mean has shape \(3, 4\) .* \(2, 3, 4\) would be right"),
        (WithAnAxisMore(), r"value has shape \(2, 3, 1\)"),
    ],
)
def test_what_is_no_network_is_a_line(network, words, observation):
    check_network(Plain(), observation)
    with pytest.raises(UserError, match=words):
        check_network(network, observation)


class Mean:
    """A learner that learns nothing."""

    def start(self, parameters, key):
        return jnp.zeros(3)

    def learn(self, state, parameters, flown, key):
        return state, parameters, {}


@pytest.mark.parametrize(
    ("learners", "words"),
    [
        ([Mean()], "list has no names"),
        ({"mine": Mean}, "learner mine: Mean is no object"),
        ({"mine": len}, "no object with start and learn"),
    ],
)
def test_what_are_no_learners_is_a_line(learners, words):
    check_learners({"mine": Mean()})
    with pytest.raises(UserError, match=words):
        check_learners(learners)


@pytest.mark.parametrize(
    ("result", "words"),
    [
        (({"mean": jnp.zeros(3)}, None), "learn gives tuple; state, parameters"),
        (({"mean": 1.0}, None, {}), r"state\['mean'\] is float\[\] after learn"),
        (({}, None, {}), r"state\['mean'\] is absent after learn"),
        (({"mean": jnp.zeros(3)}, None, {"loss": jnp.zeros(2)}), r"metric loss has"),
    ],
)
def test_what_a_learner_may_not_give_is_a_line(result, words):
    state = {"mean": jnp.zeros(3)}
    check_learning("mine", (state, None, {"loss": jnp.zeros(())}), state)
    with pytest.raises(UserError, match=words):
        check_learning("mine", result, state)
