"""`openjax plan DIAGNOSIS`: the next flight, by what it is expected to tell."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from openjax.command_line import one_thread_for_matrices, output_console, parse
from openjax.files import check_new_folder, replacing, write_json

PROGRAM = "openjax plan"


@dataclass(frozen=True)
class PlanCommand:
    """Rank segments of flight by what they are expected to tell about a diagnosis' causes.

    Writes OUT/plan.csv, set-points for openjax fly --plan and for Crazyswarm2, and OUT/plan.json.
    """

    diagnosis: Annotated[str, tyro.conf.Positional]
    """Folder of a report of openjax diagnose; or identify: the standard plan of two minutes."""
    out: Path = Path("plan")
    """Folder to write to; must not exist or be empty."""
    vehicle: str | None = None
    """The vehicle that flies (crazyflie, brushless, or a vehicle.toml); by default the vehicle that
    was diagnosed, if its file is still there.
    """


def main(arguments: Sequence[str]) -> None:
    """The command. Raises UserError for a folder that holds no report."""
    one_thread_for_matrices()
    options = parse(PlanCommand, PlanCommand(diagnosis=tyro.MISSING), arguments, PROGRAM)
    check_new_folder(options.out, "--out")
    console = output_console()
    for line in make_plan(options):
        console.print(line, soft_wrap=True)


def make_plan(arguments: PlanCommand) -> list[str]:
    """Write the plan; what to say of it."""
    from openjax.flights.manoeuvres import PERIOD
    from openjax.flights.plans import STANDARD, plan_of, write_plan
    from openjax.flights.segments import SEGMENTS
    from openjax.flying.state import SafetySettings

    promises: list[dict] = []
    if arguments.diagnosis == STANDARD and not Path(STANDARD).exists():
        segments = list(SEGMENTS)
        sentence = "The standard plan shows every effect that one vehicle can show."
    else:
        sentence, promises, segments = _advise(arguments)
    plan = plan_of(segments)
    with replacing(arguments.out) as folder:
        folder.mkdir()
        write_plan(folder / "plan.csv", plan)
        write_json(
            folder / "plan.json", {"sentence": sentence, "segments": promises, "fly": segments}
        )
    rows = [
        f"  {p['segment']:6} {p['value']:.3f}  {SEGMENTS[p['segment']].shows}" for p in promises
    ]
    if rows:
        rows.insert(0, "Probability that a segment tells two of the likely causes apart:")
    file = arguments.out / "plan.csv"
    seconds = len(plan) * PERIOD
    limit = SafetySettings().alone_time
    lands = "" if seconds < limit else f" Without --motion_capture it lands after {limit:g} s."
    return [
        sentence,
        *rows,
        f"{file}: {', '.join(segments)}; {seconds:.0f} s. "
        f"Next, openjax fly --plan {file} --uri ...{lands}",
    ]


def _advise(arguments: PlanCommand) -> tuple[str, list[dict], list[str]]:
    """The sentence, the promises of all segments, and those to fly, for a diagnosis."""
    from openjax.gap.planning.beliefs import advice_for, read_report
    from openjax.vehicle.vehicle_file import load_vehicle_file

    report = read_report(Path(arguments.diagnosis))
    # a report may have been carried to another machine, without its flights
    diagnosed = report.get("vehicle") or ""
    is_here = Path(diagnosed).is_file()
    vehicle = arguments.vehicle or (diagnosed if is_here else None)
    sentence, advice = advice_for(report, load_vehicle_file(vehicle))
    return sentence, [asdict(p) for p in advice.promises], list(advice.segments)
