"""How large the programs of a training step are: a cold start waits for their compiler,
so growth is to be seen when it comes.
"""

import jax
import pytest

from openjax.learning import make_start, preset
from openjax.learning.training_step import make_phases

MOST = {"fly": 6100, "learn_predictor": 2550, "learn_policy": 9800, "renew": 8900}
"""Operations of the preset `paper` before the compiler sees them, a tenth above what
they were; sizes do not matter.
"""


@pytest.mark.slow
def test_the_programs_of_a_training_step_have_not_grown():
    settings = preset("paper")
    phases = make_phases(settings)
    carry = jax.eval_shape(make_start(settings), jax.random.key(0))
    flown = jax.eval_shape(phases.fly, carry)[1]
    programs = [
        (phases.fly, (carry,)),
        *((learn, (carry, flown)) for learn in phases.learn),
        (phases.renew, (carry,)),
    ]
    counted = {
        phase.__name__: jax.jit(phase).lower(*arguments).as_text().count(" = ")
        for phase, arguments in programs
    }
    assert counted.keys() == MOST.keys()
    assert all(counted[name] <= most for name, most in MOST.items()), counted
