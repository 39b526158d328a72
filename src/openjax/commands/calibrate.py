"""`openjax calibrate CASE_DIR`: fit the nominal vehicle's own constants to flights, with intervals
and with what the flights can't tell, and write a `vehicle.toml` that trainer and diagnosis load.
"""

import dataclasses
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from openjax.command_line import one_thread_for_matrices, output_console, parse
from openjax.errors import UserError
from openjax.files import check_output
from openjax.show.number_tables import numbers_table
from openjax.show.progress import Steps

PROGRAM = "openjax calibrate"
SECONDS = 15.0
"""That it takes on a laptop, about."""


@dataclass(frozen=True)
class CalibrateCommand:
    """Fit thrust and torque constants, motor lag and inertia to a case's flights."""

    case: Annotated[Path, tyro.conf.Positional]
    """Folder with flight logs and a vehicle.toml."""
    out: Path | None = None
    """File to write; vehicle_calibrated.toml in the case folder if left out."""
    overwrite: bool = False
    """Replace the file if it exists."""


def run(arguments: CalibrateCommand, console: Console):
    """Calibrate, print and write; returns the Calibration. Raises UserError; writes
    nothing then.
    """
    one_thread_for_matrices()
    from openjax.calibration.calibration import calibrate
    from openjax.flights.case import load_case
    from openjax.vehicle.vehicle_file import load_vehicle_file, save_vehicle_file

    out = arguments.case / "vehicle_calibrated.toml" if arguments.out is None else arguments.out
    if out.exists() and not arguments.overwrite:
        raise UserError(
            f"{out}: exists already; use --overwrite to replace it or --out for another file"
        )
    start = time.perf_counter()
    case = load_case(arguments.case)
    check_output(out, "--out")
    for issue in case.quality:
        console.print(
            f"[yellow]{'left out' if issue.refused else 'noted'}[/] {issue.flight}: {issue.issue}"
        )
    with Steps("calibrating", {arguments.case.name: SECONDS}, console) as steps:
        steps.begin(arguments.case.name)
        result = calibrate(case)
    _print(result, console)
    if not result.calibrated():
        raise UserError(
            f"{arguments.case}: these flights determine none of the vehicle's constants; nothing "
            "is written"
        )
    vehicle_file = dataclasses.replace(
        load_vehicle_file(arguments.case), calibrated=result.calibrated()
    )
    save_vehicle_file(out, vehicle_file)
    console.print(f"{time.perf_counter() - start:.1f} s; written to [bold]{out}[/]")
    return result


def _print(result, console: Console) -> None:
    title = f"Calibrated on {len(result.flights)} flights, {result.seconds:.0f} s"
    table = numbers_table(title, ("quantity", "value", "90 % interval", "of nominal", ""))
    for name, quantity in result.quantities.items():
        for i, value in enumerate(quantity.value):
            label = name.replace("_", " ")
            if len(quantity.value) > 1:
                label += f" {('xx', 'yy', 'zz')[i]}"
            # in yaw only the torque constant over the inertia shows: this is taken as nominal
            is_assumption = name == "inertia" and i == 2
            low, high = quantity.interval90[i]
            remark = "" if quantity.determined else "not determined: nominal kept"
            if is_assumption:
                remark = "assumed"
            table.add_row(
                f"{label} [dim]{quantity.unit}[/]",
                f"{value:.4g}",
                "" if is_assumption else f"{low:.4g} … {high:.4g}",
                f"{value / quantity.nominal[i]:.3f}",
                remark,
            )
    console.print(table)
    for channel, (nominal, remaining) in result.explained.items():
        nominal_share = f"{nominal:.1%}" if nominal > 0 else "none"
        fitted_share = f"{max(remaining, 0.0):.1%}"
        console.print(
            f"{channel}: the fitted vehicle explains {fitted_share} of what changed, the given "
            f"{nominal_share}"
        )
    console.print("[bold]What these flights can't tell[/]")
    for text in result.cannot_tell:
        console.print(f"• {text}")


def main(arguments: Sequence[str]) -> None:
    """The command. Raises UserError for a case that can't be read or calibrated."""
    options = parse(CalibrateCommand, CalibrateCommand(case=tyro.MISSING), arguments, PROGRAM)
    run(options, output_console())
