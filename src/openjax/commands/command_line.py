"""Command lines from frozen dataclasses (tyro): help from docstrings, one-line errors, exit status 2."""

import contextlib
import dataclasses
import difflib
import io
import logging
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import TypeVar

from rich.console import Console

from openjax.errors import UserError

Command = TypeVar("Command")

_BOX = "╭╮╰╯│─ "


def parse(command: type[Command], default: Command, arguments: Sequence[str], program: str) -> Command:
    """The dataclass `command` filled from command-line arguments.

    Args:
      command: frozen dataclass; nested dataclasses become `--outer.inner value`, underscores or dashes alike.
      default: values of what isn't given.
      arguments: command line without the program's name.
      program: the name for the help text.

    Raises:
      UserError: unknown option or unusable value, in one line. `--help` prints and exits with status 0.
    """
    import tyro

    arguments = [_bool_like_python(argument) for argument in arguments]
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            parsed, unknown = tyro.cli(
                command, args=arguments, default=default, prog=program, return_unknown_args=True
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise UserError(_one_line(complaint.getvalue())) from None
    if unknown:
        raise UserError(_unknown(unknown[0], default, program))
    return parsed


def peek(arguments: Sequence[str], name: str) -> str | None:
    """The value of `--name` before the real parsing, which needs it to choose its defaults."""
    value = None
    for i, argument in enumerate(arguments):
        option, equals, given = argument.partition("=")
        if option.replace("-", "_") != f"__{name}":  # dashes and underscores alike, as in the real parsing
            continue
        if equals:
            value = given
        elif i + 1 < len(arguments):
            value = arguments[i + 1]
    return value


def output_console() -> Console:
    """Standard output as it is on a terminal; into a file, tables get the width that they need."""
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=120)


def run_command(main: Callable[[Sequence[str]], int | None]) -> None:
    """Run a command's `main(arguments)` and exit: 0, its own status, or 2 with one line for a UserError."""
    quiet_libraries()
    try:
        status = main(sys.argv[1:])
    except UserError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        status = 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        status = 130
    except BrokenPipeError:  # the reader, head or less, has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        status = 0
    sys.stdout.flush()
    sys.stderr.flush()
    raise SystemExit(status or 0)


def quiet_libraries() -> None:
    """Keep libraries' notes that no user can act on off the terminal; what matters comes as an exception."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    for name in ("absl", "jax._src.xla_bridge", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", message="Sharding info not provided when restoring")


def option_names(settings, prefix: str = "") -> list[str]:
    """All option names of a dataclass instance, nested ones with dots; a field `settings` adds no prefix."""
    names = []
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            names += option_names(value, prefix if field.name == "settings" else f"{prefix}{field.name}.")
        else:
            names.append(f"--{prefix}{field.name}")
    return names


def _bool_like_python(argument):
    """tyro wants True and False; people and TOML write true and false."""
    return argument.capitalize() if argument in ("true", "false") else argument


def _one_line(box: str) -> str:
    """The message of tyro's box: all lines of it up to its first rule, joined."""
    words = []
    for line in box.splitlines():
        if line.startswith("╭"):
            continue
        text = line.strip(_BOX)
        if not text and words:
            break
        words.append(text)
    message = " ".join(" ".join(words).split())
    return f"{message.rstrip('.')}; see --help"


def _unknown(argument, default, program):
    if not argument.startswith("-"):
        return f"unexpected argument {argument!r}; options are written --name value, see {program} --help"
    name = argument.split("=", 1)[0].replace("-", "_").replace("__", "--", 1)
    known = option_names(default)
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    # A setting's own name often comes without its group: --n_pursuers for --environment.n_pursuers.
    close = close or [option for option in known if option.split(".")[-1] == name.removeprefix("--")]
    hint = f"did you mean {close[0]}?" if close else f"see {program} --help"
    return f"unknown setting {argument.split('=', 1)[0]}; {hint}"
