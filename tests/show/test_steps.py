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


def test_a_file_is_told_how_far_a_long_step_is():
    """Minutes without a word look like a program that hangs."""
    output = io.StringIO()
    durations = {"compiling": 80.0, "learning": 240.0, "writing": 1.0}
    with Steps("adapting open", durations, Console(file=output)) as steps:
        for step, note in [
            ("compiling", ""),
            ("learning", "0 of 120 updates"),
            ("learning", "40 of 120 updates"),
            ("learning", "40 of 120 updates"),
            ("writing", ""),
        ]:
            steps.begin(step, note)
    first, *lines = output.getvalue().splitlines()
    assert first == "adapting open: about 5:21 ..."
    assert [line.partition(", about")[0] for line in lines] == [
        "adapting open: compiling",
        "adapting open: learning (0 of 120 updates)",
        "adapting open: learning (40 of 120 updates)",
    ]


def test_mistyped_setting():
    with pytest.raises(UserError, match=r"num_pursuer: .* did you mean num_pursuers\?"):
        openjax.make(num_pursuer=3)
