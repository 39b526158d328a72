"""Command lines from frozen dataclasses (tyro): help from docstrings, one-line errors,
exit status 2.
"""

import argparse
import contextlib
import dataclasses
import difflib
import io
import itertools
import logging
import os
import re
import shutil
import sys
import typing
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from rich.console import Console

from openjax.errors import UserError
from openjax.ranges import check_intervals, ranged_fields

Command = TypeVar("Command")

_OF_THE_DISK = ("No space left on device", "Disk quota exceeded", "Read-only file system")

LONGEST = 500
"""Characters of an error's line."""

KINDS = {
    "INT": "a whole number",
    "int()": "a whole number",
    "FLOAT": "a number",
    "float": "a number",
}
"""What an option wants, by what tyro says where it gets something else."""


def as_typed(command: str) -> str:
    """`openjax NAME ...` as it can be typed here: where its environment isn't active,
    as after `make train`, by the path of its script.
    """
    script = Path(sys.executable).with_name("openjax")
    if shutil.which("openjax") or not script.exists():
        return command
    folder = Path.cwd()
    path = script.relative_to(folder) if script.is_relative_to(folder) else script
    return f"{path}{command.removeprefix('openjax')}"


def parse(
    command: type[Command], default: Command, arguments: Sequence[str], program: str
) -> Command:
    """The dataclass `command` filled from command-line arguments.

    Args:
      command: frozen dataclass; nested dataclasses become `--outer.inner value`,
      underscores or dashes alike.
      default: values of what isn't given.
      arguments: command line without the program's name.
      program: the name for the help text.

    Raises:
      UserError: unknown option, unusable value or one outside its interval, in one
      line. `--help` prints and exits with status 0.
    """
    import tyro

    arguments = [_like_python(argument) for argument in arguments]
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            values, unknown = tyro.cli(
                command,
                args=arguments,
                default=default,
                prog=program,
                return_unknown_args=True,
                registry=_rules_of_help(),
                use_underscores=True,  # as all pages and messages write options
            )
    except SystemExit as stop:
        if stop.code in (0, None):
            raise
        raise UserError(_one_line(complaint.getvalue())) from None
    if unknown:
        raise UserError(_unknown(unknown[0], default, program))
    check_intervals(values, "--")
    return values


def _rules_of_help():
    """Rules for tyro by which `--help` shows the interval of a setting after what it
    means, and breaks lines where the terminal ends, not where the source does.
    """
    from tyro.constructors import ConstructorRegistry

    registry = ConstructorRegistry()
    inside = set()

    @registry.struct_rule
    def with_intervals(info):
        kind = info.type
        if not dataclasses.is_dataclass(kind) or kind in inside:
            return None
        # the usual rules are asked below, and would come back here
        inside.add(kind)
        try:
            spec = ConstructorRegistry.get_struct_spec(info)
        finally:
            inside.discard(kind)
        intervals = {field.name: field.interval for field in ranged_fields(kind)}
        if not hasattr(spec, "fields"):
            return spec

        def with_interval(field):
            text = field.helptext() if callable(field.helptext) else field.helptext
            text = " ".join((text or "").split())
            if field.name in intervals:
                text = f"{text} In {intervals[field.name]}.".strip()
            return dataclasses.replace(field, helptext=text or None)

        fields = tuple(with_interval(field) for field in spec.fields)
        return dataclasses.replace(spec, fields=fields)

    return registry


def peek(arguments: Sequence[str], name: str) -> str | None:
    """The value of `--name` before the real parsing, which needs it to choose its
    defaults.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    # with underscores or dashes, as in the real parsing, which also says if the value
    # is missing
    parser.add_argument(f"--{name}", f"--{name.replace('_', '-')}", nargs="?")
    return getattr(parser.parse_known_args(arguments)[0], name)


def one_thread_for_matrices() -> None:
    """Small matrices: more threads than one only wait for each other. It is read when
    NumPy is loaded, so call it before.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def output_console() -> Console:
    """Standard output as it is on a terminal; into a file, tables get the width that
    they need.
    """
    console = Console(highlight=False)
    return console if console.is_terminal else Console(highlight=False, width=120)


def run_command(main: Callable[[Sequence[str]], int | None]) -> None:
    """Run a command's `main(arguments)` and exit: 0, its own status, or 2 with one line
    for whatever isn't ours to mend.
    """
    quiet_libraries()
    for stream in (sys.stdout, sys.stderr):  # a terminal may not know every character
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    try:
        status = main(sys.argv[1:])
        sys.stdout.flush()
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        # what a shell says of a program that Ctrl-C ended
        status = 130
    except BrokenPipeError:  # the reader, head or less, has gone
        _discard_output()
        status = 0
    except Exception as error:
        line = one_line(error)
        if line is None:
            raise
        with contextlib.suppress(OSError):
            print(f"error: {line}", file=sys.stderr, flush=True)
        if isinstance(error, OSError):
            _discard_output()
        status = 2
    raise SystemExit(status or 0)


def one_line(error: BaseException) -> str | None:
    """One line about an error that the user or the machine made; None for a mistake in openjax."""
    text = " ".join(str(error).split())
    if isinstance(error, OSError):
        reason = error.strerror or text or type(error).__name__
        place = f"{error.filename}: " if error.filename is not None else ""
        text = f"{place}{reason[:1].lower()}{reason[1:]}"
    elif isinstance(error, MemoryError):
        text = "not enough memory"
    elif _is_out_of_device_memory(error):
        text = f"not enough memory on the device; fewer --num_envs need less ({text})"
    elif type(error) is RuntimeError and text.startswith("Unable to initialize backend"):
        text = f"JAX finds no device: {text}"
    elif reason := next((reason for reason in _OF_THE_DISK if reason in text), None):
        # libraries that write in C++ tell it in an error of their own
        text = f"{reason[:1].lower()}{reason[1:]} ({text})"
    elif not isinstance(error, UserError):
        return None
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


def _is_out_of_device_memory(error):
    # by name, as JAX may not be loaded
    of_jax = type(error).__name__ in ("JaxRuntimeError", "XlaRuntimeError")
    return of_jax and "RESOURCE_EXHAUSTED" in str(error)


def _discard_output() -> None:
    """Send what may still be in the buffer of standard output nowhere, so that the exit
    doesn't trip over it.
    """
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def quiet_libraries() -> None:
    """Keep libraries' notes that no user can act on off the terminal; what matters
    comes as an exception.
    """
    # 3: not even errors, as which XLA counts that it compiles slowly
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    for name in ("absl", "jax._src.xla_bridge", "asyncio"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    warnings.filterwarnings("ignore", message="Sharding info not provided when restoring")


def option_names(settings, prefix: str = "") -> list[str]:
    """All option names of a dataclass instance, nested ones with dots; a group of
    `tyro.conf.arg(name="")` adds no prefix.
    """
    names = []
    hints = typing.get_type_hints(type(settings), include_extras=True)
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if dataclasses.is_dataclass(value):
            notes = getattr(hints[field.name], "__metadata__", ())
            has_no_prefix = "" in [getattr(note, "name", None) for note in notes]
            names += option_names(value, prefix if has_no_prefix else f"{prefix}{field.name}.")
        else:
            names.append(f"--{prefix}{field.name}")
    return names


def _like_python(argument):
    """tyro wants True, False and 1000000; people and TOML write true, false and 1e6,
    too.
    """
    if re.fullmatch(r"\d+(\.\d+)?e\d{1,2}", argument) and float(argument).is_integer():
        return str(int(float(argument)))
    return argument.capitalize() if argument in ("true", "false") else argument


def _one_line(box: str) -> str:
    """The message of tyro's box: what stands in it up to its first rule, below its
    title where no box can be drawn.
    """
    lines = [line.strip("╰╯│ ") for line in box.splitlines() if not line.startswith("╭")]
    # paragraphs, between rules and empty lines
    groups = itertools.groupby(lines, key=lambda line: bool(line.strip("─-")))
    paragraphs = [" ".join(group) for says_something, group in groups if says_something]
    if "╭" not in box:
        paragraphs = paragraphs[1:] or paragraphs
    message = " ".join(paragraphs[0].split()) if paragraphs else ""
    if wrong := re.match(r"Error parsing (--\S+): (.*?)\[?('[^']*')\]?\.?$", message):
        option, reason, value = wrong.groups()
        kind = next((word for part, word in KINDS.items() if part in reason), "another value")
        name = option.replace("-", "_").replace("__", "--", 1)
        return f"{name} is {value}; expected {kind}, see --help"
    return f"{message.rstrip('.')}; see --help"


def _unknown(argument, default, program):
    if not argument.startswith("-"):
        return (
            f"unexpected argument {argument!r}; options are written --name value, see {program} "
            "--help"
        )
    name = argument.split("=", 1)[0].replace("-", "_").replace("__", "--", 1)
    options = option_names(default)

    def last_part(option):
        return re.split(r"\.|--", option)[-1]

    # a setting's own name often comes without its group, or with another: --n_pursuers
    # for --environment.n_pursuers
    options = [option for option in options if option != name]  # one that is hidden here
    close = [option for option in options if last_part(option) == last_part(name)]
    # without the dashes, which all have in common
    names = {option.lstrip("-"): option for option in options}
    close = close or [
        names[word] for word in difflib.get_close_matches(name.lstrip("-"), names, n=1, cutoff=0.6)
    ]
    hint = f"did you mean {close[0]}?" if close else f"see {program} --help"
    return f"unknown setting {argument.split('=', 1)[0]}; {hint}"
