"""`openjax sample_flights OUT`: make a case of three sample flights, to try calibration
and diagnosis on.
"""

import dataclasses
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from openjax.command_line import output_console, parse
from openjax.errors import UserError, suggestion
from openjax.files import check_new_folder, replacing
from openjax.ranges import Interval, Seed
from openjax.vehicle.effect_names import effect_names

PROGRAM = "openjax sample_flights"
DECIMALS = {"t": 2, "vbat": 3} | dict.fromkeys("x y z qw qx qy qz m1 m2 m3 m4".split(), 5)
_REST = 4  # decimals of all other columns
_EFFECT_HELP = (
    "Effects of the vehicle that the simulator lacks, one or several: "
    f"none, {', '.join(effect_names())}."
)


@dataclass(frozen=True)
class SampleFlightsCommand:
    """Fly openjax's own vehicle through three manoeuvres and write the logs as a case."""

    out: Annotated[Path, tyro.conf.Positional]
    """Folder to write the case to; must not exist or be empty."""
    effect: Annotated[tuple[str, ...], tyro.conf.arg(help=_EFFECT_HELP)] = ("none",)
    duration: Annotated[float, Interval("[3, 120]")] = 10.0
    """Seconds per flight."""
    seed: Seed = 0
    """Random numbers: trajectories, noise, biases."""


def make_case(arguments: SampleFlightsCommand) -> list[Path]:
    """Write the case; returns its files. Raises UserError for an unknown effect or a
    folder that isn't empty.
    """
    from openjax.flights.csv_table import write_csv
    from openjax.flights.manoeuvres import references
    from openjax.flights.reading import LOG_COLUMNS
    from openjax.flights.samples import fly, log_of
    from openjax.vehicle.effects import EFFECTS
    from openjax.vehicle.vehicle_file import load_vehicle_file, save_vehicle_file

    names = _checked_effects(arguments.effect, EFFECTS)
    check_new_folder(arguments.out, "OUT")
    effects = {name: EFFECTS[name].card.sample for name in names}
    source = (
        f"simulated: openjax.sample_flights, seed {arguments.seed}, "
        f"effect: {', '.join(arguments.effect)}"
    )
    log = {"source": source, "motor_rows": "mean", "floor_z": 0.0}
    # On a scale a vehicle that weighs more would have shown it.
    is_weighed = not any(EFFECTS[name].card.weighed for name in names)
    vehicle_file = dataclasses.replace(load_vehicle_file(), mass_weighed=is_weighed, log=log)
    decimals = {c: DECIMALS.get(c, _REST) for c in LOG_COLUMNS}
    of_others = any(EFFECTS[name].card.of_others for name in names)
    flights = references(arguments.seed, arguments.duration, neighbour=of_others)
    with replacing(arguments.out) as folder:
        folder.mkdir()
        for number, (name, reference) in enumerate(flights.items()):
            # the vehicle that flies is the one that is described, but for the effects
            seed = 1000 * arguments.seed + number
            columns = fly(vehicle_file.vehicle, vehicle_file.vehicle, reference, seed, effects)
            write_csv(folder / f"{name}.csv.gz", log_of(columns, name), decimals)
        save_vehicle_file(folder / "vehicle.toml", vehicle_file)
    return sorted(arguments.out.iterdir())


def _checked_effects(names: tuple[str, ...], library: Collection[str]) -> tuple[str, ...]:
    """The effects that act. Raises UserError for one that there isn't, twice the same,
    or none beside others.
    """
    for name in names:
        if name not in ("none", *library):
            raise UserError(f"--effect {name}: no such effect; {suggestion(name, library)}")
    is_unclear = "none" in names and len(names) > 1
    if len(set(names)) < len(names) or not names or is_unclear:
        words = " ".join(names) or "nothing"
        raise UserError(f"--effect {words}: name none alone, or each effect once")
    return tuple(name for name in names if name != "none")


def main(arguments: Sequence[str]) -> None:
    """The command. Raises UserError for an unknown effect or an unusable folder."""
    options = parse(
        SampleFlightsCommand, SampleFlightsCommand(out=tyro.MISSING), arguments, PROGRAM
    )
    files = make_case(options)
    console = output_console()
    console.print(
        f"[bold]{options.out}[/]: three flights of {options.duration:g} s, "
        f"effect{'s' * (len(options.effect) > 1)}: {', '.join(options.effect)}"
    )
    for file in files:
        console.print(f"  {file.name}  {file.stat().st_size / 1024:.1f} KiB")
