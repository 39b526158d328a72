"""Every setting's range, all at once: what is inside is taken, what is outside is
refused by name, in one line.
"""

import dataclasses
import math
import re
import typing

import pytest
from hypothesis import given
from hypothesis import strategies as st

from openjax.command_line import parse
from openjax.commands import calibrate, diagnose, export, fly, sample_flights, virtual_crazyflie
from openjax.commands.adapt import AdaptCommand
from openjax.commands.benchmark import BenchmarkCommand
from openjax.commands.evaluate import EvaluateCommand
from openjax.commands.view import ViewCommand
from openjax.errors import UserError
from openjax.files import to_plain
from openjax.flying.state import SafetySettings
from openjax.learning import GeneratorSettings, MappoSettings, TrainSettings
from openjax.learning.settings import AdaptSettings
from openjax.plain import from_plain
from openjax.policy import NetworkSettings, PredictorSettings
from openjax.pursuit import PursuitSettings, RewardSettings
from openjax.ranges import Interval, check_intervals, ranged_fields
from openjax.runs.train_command import TrainCommand
from openjax.virtual_crazyflie.link import LinkFaults

SETTINGS = (
    AdaptSettings,
    GeneratorSettings,
    LinkFaults,
    MappoSettings,
    NetworkSettings,
    PredictorSettings,
    PursuitSettings,
    RewardSettings,
    SafetySettings,
    TrainSettings,
)
COMMANDS = (
    AdaptCommand,
    BenchmarkCommand,
    EvaluateCommand,
    TrainCommand,
    ViewCommand,
    export.ExportCommand,
    fly.FlyCommand,
    virtual_crazyflie.VirtualCrazyflieCommand,
)
OF_FLIGHTS = (calibrate.CalibrateCommand, diagnose.Options, sample_flights.SampleFlightsCommand)
"""They can't be made without a folder."""
FIELDS = [(kind, field) for kind in (*SETTINGS, *COMMANDS) for field in ranged_fields(kind)]


def test_every_number_declares_a_range():
    numbers = {int, float, int | None, float | None}
    for kind in (*SETTINGS, *COMMANDS, *OF_FLIGHTS):
        ranged = {field.name for field in ranged_fields(kind)}
        for name, hint in typing.get_type_hints(kind).items():
            assert name in ranged or hint not in numbers, (
                f"{kind.__module__}.{kind.__name__}.{name}"
            )


def outside(interval: Interval):
    """Numbers that aren't in an interval."""
    return st.one_of(
        st.sampled_from([math.nan, math.inf, -math.inf, 10**30, -1e300, 1e300]),
        st.floats(max_value=interval.low - 1e-3 * (1.0 + abs(interval.low)), allow_infinity=False),
        st.floats(
            min_value=interval.high + 1e-3 * (1.0 + abs(interval.high)), allow_infinity=False
        ),
        st.integers(max_value=math.ceil(interval.low) - 1),
        st.integers(min_value=math.floor(interval.high) + 1),
    )


@given(data=st.data())
def test_what_is_outside_is_refused_by_name(data):
    kind, field = data.draw(st.sampled_from(FIELDS))
    value = data.draw(st.one_of(outside(field.interval), st.sampled_from(["1", True, [1], {}])))
    # of a setting, already its making is refused; a command is checked when it was read
    with pytest.raises(UserError) as error:
        check_intervals(
            dataclasses.replace(kind(), **{field.name: (value,) if field.several else value})
        )
    message = str(error.value)
    assert field.name in message and str(field.interval) in message
    assert "\n" not in message and len(message) < 300


@given(data=st.data())
def test_what_is_inside_is_taken_unless_settings_contradict_each_other(data):
    kind, field = data.draw(
        st.sampled_from([(kind, field) for kind, field in FIELDS if kind in SETTINGS])
    )
    numbers = st.integers(math.ceil(field.interval.low), math.floor(field.interval.high))
    if field.kind is float:
        numbers = st.floats(field.interval.low, field.interval.high)
    value = data.draw(numbers.filter(lambda number: number in field.interval))
    try:
        made = dataclasses.replace(kind(), **{field.name: (value,) if field.several else value})
    except UserError as error:  # for another reason than its interval
        assert "it must be in" not in str(error) and "whole number in" not in str(error)
        return
    if kind is TrainSettings:
        assert from_plain(TrainSettings, to_plain(made), "settings") == made


def test_the_ends_belong_to_an_interval_as_its_brackets_say():
    assert 0 not in Interval("(0, 1]") and 1 in Interval("(0, 1]")
    assert 0 in Interval("[0, 1)") and 1 not in Interval("[0, 1)")
    for wrong in ("[1, 0]", "[0, inf]", "0..1", "[0 1]"):
        with pytest.raises(ValueError, match="isn't a bounded interval"):
            Interval(wrong)


def test_help_shows_the_range(capsys):
    with pytest.raises(SystemExit):
        parse(TrainCommand, TrainCommand(), ["--help"], "train")
    shown = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert (
        "Adam step size at the start; falls linearly to zero over `total_steps`. In (0, 1]."
        in shown
    )
    assert "In [1, 8]." in shown
    # each option stands alone, and is written as the pages write it
    unexplained = re.findall(
        r"(--[\w.]+) (?:INT|FLOAT|\{None\}\|INT|\{None\}\|FLOAT) In [\[(]", shown
    )
    assert not unexplained
    assert not re.search(r"\.\.\. In | \.\.\. [a-z]", shown), "goes on in another option's text"
    assert "--layout_episodes" in shown
