"""The time left that a command shows."""

import io
import time

import pytest
from rich.console import Console

import openjax
from openjax.errors import UserError
from openjax.show.progress import Steps, duration


def test_time_left_follows_this_machine(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    steps = Steps("work", {"slow": 10.0, "fast": 5.0, "last": 5.0}, Console(file=io.StringIO()))
    steps.begin("slow")
    assert steps.seconds_left(now[0]) == 20.0
    now[0] += 20.0  # twice what was expected
    steps.begin("fast")
    assert steps.seconds_left(now[0]) == pytest.approx(20.0)
    assert steps.seconds_left(now[0] + 4.0) == pytest.approx(16.0)
    assert steps.seconds_left(now[0] + 40.0) == pytest.approx(
        10.0
    )  # late: the last step is still to come


def test_nothing_but_text_goes_into_files():
    output = io.StringIO()
    with Steps("work", {"only": 1.0}, Console(file=output)) as steps:
        steps.begin("only")
    assert output.getvalue() == ""
    assert duration(65.2) == "1:05"


def test_mistyped_setting():
    with pytest.raises(UserError, match=r"num_pursuer: .* did you mean num_pursuers\?"):
        openjax.make(num_pursuer=3)
