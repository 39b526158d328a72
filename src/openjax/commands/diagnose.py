"""Diagnose the sim-to-real gap of flights: `openjax diagnose CASE_DIR [CASE_DIR
...]`.
"""

import sys
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro
from rich.panel import Panel
from rich.text import Text

from openjax.command_line import one_line, one_thread_for_matrices, output_console, parse
from openjax.errors import UserError
from openjax.files import check_output, check_output_folder, replacing, write_json
from openjax.show.progress import Steps
from openjax.store.compiled_programs import cache_programs
from openjax.vehicle.effect_names import effect_names

PROGRAM = "openjax diagnose"
SECONDS = 5.0
"""Of a case on a laptop, about."""
_WITHOUT_HELP = f"Effects that are not to be looked for: any of {', '.join(effect_names())}."


@dataclass(frozen=True)
class Options:
    """Diagnose the sim-to-real gap: where the simulator differs from flights, which
    effect causes it, how far it shrinks.

    Writes OUT/<case>/report.html, report.json and effects.toml (which `openjax train
    --effects` flies with).
    """

    cases: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of flight logs, each with a vehicle.toml."""
    reference: tuple[Path, ...] = ()
    """Folders of earlier flights of the same vehicle, one for each day: the vehicle is
    learnt from them first, and the report says what changed since; for trims and rotors
    motor commands alone are enough.
    """
    out: Path = Path("diagnosis")
    """Where the reports go, one folder per case."""
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
    console = output_console()
    names = _checked_names(options)
    from openjax.gap.model.library import library

    # a misspelt effect is an error of all cases, and said before the first
    library(options.without)
    predictions = {}
    failures = 0
    for i, (folder, name) in enumerate(zip(options.cases, names, strict=True)):
        try:
            # shows how long all that are still to come will take
            with Steps("diagnosing", {case: SECONDS for case in names[i:]}, console) as steps:
                steps.begin(name)
                title, lines, prediction = _diagnosis(
                    options, folder, name, partial(steps.begin, name)
                )
        except UserError as error:
            failures += 1
            print(f"error: {one_line(error)}", file=sys.stderr)
        except Exception as error:  # a fault of the program in one case must not cost the others
            failures += 1
            print(f"error: {_unforeseen(name, error)}", file=sys.stderr)
        else:
            predictions[name] = prediction
            console.print(
                Panel(Text("\n".join(lines)), title=f"{name}: {title}", title_align="left")
            )
    if options.predictions is not None and predictions:
        write_json(options.predictions, predictions)
    return 2 if failures == len(names) else 0


def _checked_names(options: Options) -> list[str]:
    """What the cases are called; all that can be wrong with where they're written to is
    said before the work.
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
    for name in names:
        if (options.out / name).exists() and not options.overwrite:
            raise UserError(
                f"{options.out / name} already exists: choose another --out or give --overwrite"
            )
    check_output(options.predictions, "--predictions")
    return names


def _diagnosis(
    options: Options, folder: Path, name: str, tell: Callable[[str], None]
) -> tuple[str, list[str], dict]:
    """Title, lines and prediction of what causes a case's gap, or of what changed since
    the reference, after its report was written whole.
    """
    from openjax.gap.folders import diagnose_folder
    from openjax.gap.report import write_report

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
    return answer.title, lines, answer.prediction()


def _unforeseen(name: str, error: Exception) -> str:
    """One line on a fault of the program: the case, what was raised, and where."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    line = f"{Path(place.filename).name}:{place.lineno}"
    text = " ".join(str(error).split())
    return (
        f"{name}: {type(error).__name__} in {line} ({text}): a fault of the program, please "
        "report it"
    )
