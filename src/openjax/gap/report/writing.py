"""A report as files: `report.json`, `report.html`, and `effects.toml` for the
trainer.
"""

import json
from pathlib import Path

import numpy as np

from openjax.gap.identification.corrections import corrections
from openjax.gap.model.library import CARDS
from openjax.gap.report.report import Report
from openjax.gap.trims.change import Change
from openjax.vehicle.effects import EFFECTS, save_effects

Values = dict[str, dict[str, float]]
Intervals = dict[str, dict[str, tuple[float, float]]]


def write_report(answer: Report | Change, folder: Path, pictures: bool = True) -> None:
    """Write `report.json`, of a diagnosis `effects.toml`, and with `pictures`
    `report.html` into an existing folder.
    """
    text = json.dumps(answer.to_dict(), indent=1)
    (folder / "report.json").write_text(text + "\n", encoding="utf-8")
    if isinstance(answer, Report):
        notes = " ".join(answer.in_words()[:2])
        save_effects(folder / "effects.toml", *to_fly(answer), notes=notes)
    if pictures:
        (folder / "report.html").write_text(_page(answer, folder), encoding="utf-8")


def _page(answer: Report | Change, folder: Path) -> str:
    # loads Matplotlib, which takes a second
    from openjax.gap.report.page import page_of
    from openjax.gap.report.trims_page import page_of_trims

    return page_of(answer, folder) if isinstance(answer, Report) else page_of_trims(answer)


def to_fly(report: Report) -> tuple[Values, Intervals]:
    """Values and 90 % intervals by effect and parameter for a simulator that knows no
    voltage: the battery and what depends on it are as in the flights, at their median.
    """
    values: Values = {}
    intervals: Intervals = {}
    for effect, estimates in report.parameters.items():
        # what is no size isn't flown with
        sizes = {name: estimate for name, estimate in estimates.items() if estimate.is_size}
        values[effect] = {name: estimate.value for name, estimate in sizes.items()}
        intervals[effect] = {name: estimate.interval90 for name, estimate in sizes.items()}
    if report.identification is not None:
        # what was measured directly is more exact than what was fitted beside all else
        better, narrower = corrections(report.identification, report.named)
        values |= {e: values.get(e, {}) | parameters for e, parameters in better.items()}
        intervals |= {e: intervals.get(e, {}) | parameters for e, parameters in narrower.items()}
    # what wasn't fitted keeps the value at which it does nothing
    values = {e: EFFECTS[e].none() | parameters for e, parameters in values.items()}
    voltage = _median_voltage(report)
    if voltage is None:
        return values, intervals
    for effect, parameters in values.items():
        at_voltage = CARDS[effect].at_voltage
        if at_voltage is not None:
            values[effect], intervals[effect] = at_voltage(parameters, intervals[effect], voltage)
    return values, intervals


def _median_voltage(report: Report) -> float | None:
    """V, over all flights; None where none was logged."""
    evidence = report.plots.get("evidence")
    if evidence is None:
        return None
    voltages = [t.voltage for t in evidence.tracks if t.voltage is not None]
    return float(np.median(np.concatenate(voltages))) if voltages else None
