"""A few hundred hostile inputs, changed at random from fixed seeds, and a few damaged
checkpoints.
"""

from collections import Counter

import pytest

from tests.fuzz.cases import try_cases
from tests.fuzz.damages import make_checkpoints, try_damages
from tests.fuzz.inputs import KINDS

pytestmark = pytest.mark.slow

NUMBER = {"settings files": 60, "layouts": 60, "effects files": 60, "vehicle files": 60}


@pytest.mark.parametrize("kind", KINDS)
def test_hostile_input_is_refused_in_one_line_or_taken_sanely(kind):
    cases = try_cases(kind, range(NUMBER.get(kind, 15)))
    failed = [(seed, text) for _, seed, outcome, text in cases if outcome == "failed"]
    assert not failed, failed[0]
    assert Counter(outcome for _, _, outcome, _ in cases)["refused"]


def test_no_damage_to_a_checkpoint_goes_unseen(tmp_path):
    make_checkpoints(tmp_path)
    outcomes = Counter(try_damages(tmp_path, range(8)))
    assert set(outcomes) <= {"same", "before", "refused"} and outcomes["before"]
