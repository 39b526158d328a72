"""One place turns whatever isn't openjax's to mend into one line with exit status 2;
mistakes of openjax keep their trace.
"""

import io
import os
import re
import sys

import pytest

from openjax.command_line import LONGEST, as_typed, parse, run_command
from openjax.commands.exploit import ExploitCommand
from openjax.errors import UserError


def raising(error):
    def main(arguments):
        raise error

    return main


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (UserError("too\n  wide"), "error: too wide"),
        (
            OSError(28, "No space left on device", "runs/a"),
            "error: runs/a: no space left on device",
        ),
        (PermissionError(13, "Permission denied", "out"), "error: out: permission denied"),
        (
            ValueError("tensorstore: No space left on device [/x]"),
            "error: no space left on device (tensorstore",
        ),
        (MemoryError(), "error: not enough memory"),
        (UserError("x" * 10_000), "error: xxx"),
    ],
)
def test_what_the_machine_or_the_user_did_is_one_line(error, line, capsys):
    with pytest.raises(SystemExit) as stop:
        run_command(raising(error))
    shown = capsys.readouterr().err
    assert stop.value.code == 2
    assert (
        shown.startswith(line)
        and shown.count("\n") == 1
        and len(shown) <= LONGEST + len("error: \n")
    )


def test_a_mistake_of_openjax_is_not_hidden():
    with pytest.raises(ZeroDivisionError):
        run_command(raising(ZeroDivisionError("division by zero")))


def test_a_terminal_that_lacks_characters_and_a_full_disk_for_the_output(monkeypatch, capsys):
    narrow = io.TextIOWrapper(io.BytesIO(), encoding="latin-1")
    monkeypatch.setattr(sys, "stdout", narrow)
    with pytest.raises(SystemExit) as stop:
        run_command(lambda arguments: print("5 – 6 steps"))
    assert stop.value.code == 0 and narrow.buffer.getvalue() == b"5 ? 6 steps\n"
    if os.path.exists("/dev/full"):
        with open("/dev/full", "w") as full:
            monkeypatch.setattr(sys, "stdout", full)
            with pytest.raises(SystemExit) as stop:
                run_command(lambda arguments: print("something"))
            monkeypatch.undo()
        assert stop.value.code == 2
        assert "no space left on device" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("line", "told"),
    [
        ("--num_envs abc", "--num_envs is 'abc'; expected a whole number"),
        ("--minutes soon", "--minutes is 'soon'; expected a number"),
        ("--learning.learners 2", "unknown setting --learning.learners; did you mean --learners?"),
        ("--capture_radius 1", "did you mean --environment.capture_radius?"),
        ("--environment.physics bullet", "Expected one of"),
        ("--learners 65", "learners is 65; it must be a whole number in"),
    ],
)
def test_a_mistyped_option_is_told_what_would_be_right(line, told):
    with pytest.raises(UserError, match=re.escape(told)) as error:
        parse(ExploitCommand, ExploitCommand(), line.split(), "openjax exploit")
    assert "\n" not in str(error.value)


def test_numbers_and_truths_may_be_written_as_people_do():
    line = "--total_steps 2e6 --environment.observe_position true --minutes 1e1".split()
    command = parse(ExploitCommand, ExploitCommand(), line, "openjax exploit")
    settings = command.learning
    game = command.environment
    assert (settings.total_steps, game.observe_position, command.minutes) == (2_000_000, True, 10.0)


def test_what_to_type_next_can_be_typed_where_the_environment_isnt_active(tmp_path, monkeypatch):
    """As after `make train`, which installs into `.venv` and activates nothing."""
    scripts = tmp_path / ".venv" / "bin"
    scripts.mkdir(parents=True)
    for name in ("python", "openjax"):
        (scripts / name).touch(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "executable", str(scripts / "python"))
    monkeypatch.setenv("PATH", str(tmp_path))
    assert as_typed("openjax view --policy runs/a") == ".venv/bin/openjax view --policy runs/a"
    monkeypatch.setenv("PATH", str(scripts))
    assert as_typed("openjax view --policy runs/a") == "openjax view --policy runs/a"
