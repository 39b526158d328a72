"""Diagnose the sim-to-real gap of flights: `openjax diagnose CASE_DIR [CASE_DIR ...]`."""

import contextlib
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.panel import Panel
from rich.text import Text

from openjax.command_line import one_line, one_thread_for_matrices, output_console, parse
from openjax.errors import UserError
from openjax.files import (
    check_output,
    check_output_folder,
    claim,
    replacing,
    write_json,
    write_text,
)
from openjax.show.progress import Steps
from openjax.store.compiled_programs import cache_programs
from openjax.vehicle.effect_names import effect_names

if TYPE_CHECKING:
    from openjax.gap.report.fleet import Member

PROGRAM = "openjax diagnose"
SECONDS = 5.0
"""Of a case on a laptop, about."""
TOGETHER = "vehicles"
"""Name of the report of several vehicles."""
_WITHOUT_HELP = f"Effects to leave out of the search, any of {', '.join(effect_names())}."


@dataclass(frozen=True)
class Options:
    """Diagnose the sim-to-real gap: where the simulator differs from flights, which
    effect causes it, how far it shrinks.

    Writes OUT/<case>/report.html, report.json and effects.toml (which `openjax train
    --effects` flies with); of several vehicles, OUT/vehicles.html shows them side by side.
    """

    cases: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of flight logs, one for each vehicle, each with a vehicle.toml."""
    reference: tuple[Path, ...] = ()
    """Folders of earlier flights of the same vehicle, one for each day: the vehicle is
    learnt from them first, and the report says what changed since; for trims and rotors
    motor commands alone are enough.
    """
    out: Path = Path("diagnosis")
    """Folder of the reports, one folder per case."""
    predictions: Path | None = None
    """Also write all cases' answers into this one JSON file."""
    without: Annotated[tuple[str, ...], tyro.conf.arg(help=_WITHOUT_HELP)] = ()
    html: bool = True
    """Write report.html (pictures take about a second per case)."""
    overwrite: bool = False
    """Replace reports that are already in OUT."""


def main(arguments: Sequence[str]) -> int:
    """Run the command; the exit status is 0, or 2 if nothing could be diagnosed."""
    options = parse(Options, Options(cases=tyro.MISSING), arguments, PROGRAM)
    if "--reference" in arguments and not options.reference:
        raise UserError("--reference needs at least one folder of flights before the change")
    return run(options)


def run(options: Options) -> int:
    """Diagnose every case; a case that can't be used is named and the rest goes on.
    Raises UserError for bad options.
    """
    one_thread_for_matrices()
    cache_programs()
    names = _checked_names(options)
    from openjax.gap.model.library import library

    # a misspelt effect is an error of all cases, and said before the first
    library(options.without)
    with contextlib.ExitStack() as stack:
        for name in names:
            stack.enter_context(claim(options.out / name, "--out"))
        answers = _answers(options, names)
        if len(answers) > 1:
            _compare(options, [answer.member for answer in answers])
        if options.predictions is not None and answers:
            write_json(options.predictions, {a.member.name: a.prediction for a in answers})
    return 0 if answers else 2


@dataclass(frozen=True)
class Answer:
    """The remains of a case once its report is written."""

    member: "Member"
    title: str
    lines: list[str]
    prediction: dict


def _answers(options: Options, names: Sequence[str]) -> list[Answer]:
    """The answers to the cases that can be diagnosed, each shown as it comes."""
    console = output_console()
    answers = []
    for i, (folder, name) in enumerate(zip(options.cases, names, strict=True)):
        try:
            # shows how long all that are still to come will take
            with Steps("diagnosing", {case: SECONDS for case in names[i:]}, console) as steps:
                steps.begin(name)
                answer = _diagnosis(options, folder, name, partial(steps.begin, name))
        except Exception as error:  # one case must not cost the others
            line = one_line(error)
            if line is None:
                line = _unforeseen(name, error)
            elif not isinstance(error, UserError):
                line = f"{name}: {line}"
            print(f"error: {line}", file=sys.stderr)
            continue
        answers.append(answer)
        text = Text("\n".join(answer.lines))
        console.print(Panel(text, title=f"{name}: {answer.title}", title_align="left"))
    return answers


def _compare(options: Options, members: Sequence["Member"]) -> None:
    """Show and write in what several vehicles differ from each other."""
    from openjax.gap.report.fleet import fleet_in_words, fleet_to_dict, page_of_fleet

    lines = fleet_in_words(members)
    write_json(options.out / f"{TOGETHER}.json", fleet_to_dict(members))
    if options.html:
        write_text(options.out / f"{TOGETHER}.html", page_of_fleet(members))
    lines.append(f"({options.out / TOGETHER}{'.html' if options.html else '.json'})")
    title = f"{len(members)} vehicles side by side"
    output_console().print(Panel(Text("\n".join(lines)), title=title, title_align="left"))


def _checked_names(options: Options) -> list[str]:
    """The names of the cases. Anything wrong with the folders that they are written to is said
    before the work.
    """
    if not options.cases:
        raise UserError(
            "no case given: name at least one folder of flight logs with a vehicle.toml"
        )
    names = [case.resolve().name for case in options.cases]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise UserError(f"two cases are called {twice!r}: their reports would overwrite each other")
    cases = {case.resolve() for case in options.cases}
    itself = next((day for day in options.reference if day.resolve() in cases), None)
    if itself is not None:
        raise UserError(
            f"--reference {itself}: is the case itself; name flights of before the change"
        )
    check_output_folder(options.out, "--out")
    for path in _outputs(options, names):
        if path.exists() and not options.overwrite:
            raise UserError(f"{path} already exists: choose another --out or give --overwrite")
    check_output(options.predictions, "--predictions")
    return names


def _outputs(options: Options, names: Sequence[str]) -> list[Path]:
    """The files to write into OUT."""
    together = [options.out / f"{TOGETHER}.json"] if len(names) > 1 else []
    return [*(options.out / name for name in names), *together]


def _diagnosis(options: Options, folder: Path, name: str, tell: Callable[[str], None]) -> Answer:
    """The causes of a case's gap, or the change since the reference, once its report is written."""
    from openjax.gap.folders import diagnose_folder
    from openjax.gap.report import write_report
    from openjax.gap.report.fleet import member_of

    begin = time.perf_counter()
    answer = diagnose_folder(folder, options.reference, options.without, tell)
    seconds = time.perf_counter() - begin
    for text in answer.left_out:
        print(f"warning: {name}: left out: {text}", file=sys.stderr)
    tell("writing the report")
    with replacing(options.out / name) as partial_folder:
        partial_folder.mkdir()
        write_report(answer, partial_folder, options.html)
    report_file = options.out / name / ("report.html" if options.html else "report.json")
    more = f" (and {len(answer.notes) - 1} more in the report)"
    remark = [
        f"Noted in the logs: {text}{more * (len(answer.notes) > 1)}." for text in answer.notes[:1]
    ]
    lines = [*remark, *answer.in_words(), f"({seconds:.1f} s; {report_file})"]
    return Answer(member_of(name, answer), answer.title, lines, answer.prediction())


def _unforeseen(name: str, error: Exception) -> str:
    """One line on a fault of the program: the case, what was raised, and where."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    line = f"{Path(place.filename).name}:{place.lineno}"
    text = " ".join(str(error).split())
    return f"{name}: {type(error).__name__} in {line} ({text}): a bug in openjax; please report it"
