"""Every command line of a page or beside a result can be typed today: its program is there and
takes its options. A result that a program of before made names the commit that has it.
"""

import argparse
import contextlib
import importlib
import io
import json
import re
import runpy
import shlex
from pathlib import Path

import pytest
import tyro

from openjax.__main__ import COMMANDS
from openjax.errors import UserError
from openjax.runs import request

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "experiments" / "results"
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "experiments/README.md")),
    *(ROOT / "docs").glob("*.md"),
    *(ROOT / "docs" / "tutorials").glob("*.md"),
    *RESULTS.rglob("*.md"),
]
COMMIT = re.compile(r"\b(?=[a-f]*\d)(?=\d*[a-f])[0-9a-f]{7,40}\b")
COMMAND = re.compile(
    rf"(?:^|(?<=; )|(?<=then ))(openjax (?:{'|'.join(COMMANDS)})|"
    r"python -m (?:openjax|experiments|tests)\.[\w.]+)(?= )((?:'[^']*'|[^'])*?)(?=; |, |$| \(| #| &| then)"
)
"""A command with options, up to what a text says after it."""


def commands_in(text: str) -> list[str]:
    """Those that begin a text, or are named among others; none with a commit beside it."""
    return (
        [] if COMMIT.search(text) else [a + b for a, b in COMMAND.findall(" ".join(text.split()))]
    )


def of_record(stored, parent=None) -> list[str]:
    """The commands of a stored result, but for those whose record has a commit or a program."""
    if isinstance(stored, str):
        return [] if {"program", "commit"} & set(parent or {}) else commands_in(stored)
    if isinstance(stored, dict):
        return [command for value in stored.values() for command in of_record(value, stored)]
    if isinstance(stored, list):
        return [command for value in stored for command in of_record(value, parent)]
    return []


def of_page(text: str) -> list[str]:
    """The commands of a page: lines of its blocks, and what stands in backticks."""
    blocks = re.findall(r"^```\w*\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    lines = [line.strip() for block in blocks for line in block.splitlines()]
    rest = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    spans = [
        span
        for paragraph in rest.split("\n\n")
        if not COMMIT.search(paragraph)
        for span in re.findall(r"`([^`]+)`", paragraph)
    ]
    return [command for text in (*lines, *spans) for command in commands_in(text)]


class ParsedError(Exception):
    """The options were taken: nothing has to run."""


def parse_alone(monkeypatch, words: list[str]) -> None:
    """Let a program read its options, and stop there."""
    name = words[1] if words[0] == "openjax" else words[2]
    arguments = words[2:] if words[0] == "openjax" else words[3:]
    if name.removeprefix("openjax.") in COMMANDS:
        module = importlib.import_module(f"openjax.commands.{name.removeprefix('openjax.')}")
        for place in (module, request):
            if parse := getattr(place, "parse", None):
                monkeypatch.setattr(place, "parse", lambda *a, p=parse: stop(p, *a))
        module.main(arguments)
        return
    argparse_parse = argparse.ArgumentParser.parse_args
    monkeypatch.setattr(
        argparse.ArgumentParser, "parse_args", lambda p, *_: stop(argparse_parse, p, arguments)
    )
    tyro_parse = tyro.cli
    monkeypatch.setattr(tyro, "cli", lambda kind: stop(tyro_parse, kind, args=arguments))
    runpy.run_module(name, run_name="__main__", alter_sys=True)


def stop(parse, *arguments, **options):
    """Parse, and go no further."""
    parse(*arguments, **options)
    raise ParsedError


def typed(command: str) -> list[str]:
    """Its words, with a number in place of a seed that isn't told."""
    return ["0" if word in ("S", "SEED") else word for word in shlex.split(command)]


@pytest.mark.parametrize(
    "path", [*PAGES, *RESULTS.rglob("*.json")], ids=lambda path: path.relative_to(ROOT).as_posix()
)
def test_commands_can_be_typed(path, monkeypatch):
    text = path.read_text(encoding="utf-8")
    commands = of_record(json.loads(text)) if path.suffix == ".json" else of_page(text)
    for command in dict.fromkeys(commands):
        said = io.StringIO()
        with (
            monkeypatch.context() as patch,
            contextlib.redirect_stdout(said),
            contextlib.redirect_stderr(said),
        ):
            try:
                parse_alone(patch, typed(command))
            except ParsedError:
                continue
            except UserError as error:
                # the run or the file that a page's reader has isn't here
                absent = ("is no run", "no such settings file")
                assert any(words in str(error) for words in absent), command
                continue
            except SystemExit as end:
                assert not end.code, f"{command}: {said.getvalue()}"
                continue
        raise AssertionError(f"{command} reads no options")
