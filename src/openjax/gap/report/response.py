"""The measured vehicle, before any cause is considered: its numbers and its response to its motors,
beside the simulator's.
"""

from collections.abc import Collection

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator

from openjax.gap.identification.quantities import KINDS, MATTERS, Identification, Quantity, words_of
from openjax.gap.identification.responses import Pair
from openjax.gap.model.library import CARDS
from openjax.gap.report.report import Report
from openjax.show.pages import AFTER, BEFORE, STYLE, as_svg

DIFFERS = ("differs: see the causes", "differs: in effects.toml, but no named cause")
"""What is said of numbers that matter."""
PANEL = (2.9, 4.0)  # inches, of one axis


def response_of(report: Report) -> dict | None:
    """The contents of `response.html.jinja`: sentences, remarks, rows of numbers and the pictures
    (SVG) of every axis; None if nothing was measured.
    """
    does = report.identification
    if does is None:
        return None
    rows = [
        {
            "name": words_of(name),
            "value": q.as_text(),
            "simulator": q.beside(q.simulator),
            "effect": q.effect.replace("_", " "),
            "meaning": meaning_of(name, q, report),
            "differs": q.differs,
            "matters": meaning_of(name, q, report) in DIFFERS,
        }
        for name, q in report.numbers.items()
    ]
    return {
        "sentences": report.measured_in_words() or [does.sentence()],
        "limits": _limits(),
        "remarks": does.remarks if does.trustworthy else does.remarks[1:],
        "rows": sorted(rows, key=lambda row: not row["matters"]),
        "pictures": pictures_of(does),
    }


def _limits() -> str:
    """From which differences on a number matters."""
    times = {kind.effect for kind in KINDS.values() if kind.unit == "s"}
    sizes = [
        f"{least * 1e3:.0f} ms of {e}" if e in times else f"{least:.0%} of {e}"
        for e, least in MATTERS.items()
    ]
    text = f"That matters from {', '.join(sizes)} on, or if predictions get worse without it."
    return text.replace("_", " ").replace("%", " %")


def meaning_of(name: str, quantity: Quantity, report: Report) -> str:
    """Words that say if a number differs from the simulator's, and if that matters."""
    if not quantity.differs:
        return "as in the simulator"
    if quantity.effect in report.named or moves(name, report.named):
        return DIFFERS[0]
    if not report.identification.trustworthy:
        return "differs, but is not trusted"
    if quantity.effect in report.departures:
        return DIFFERS[1]
    if report.reference:
        return "differs from the simulator"
    return "differs too little to matter"


def moves(name: str, effects: Collection[str]) -> bool:
    """True if one of the `effects` moves a number that belongs to another one: a weaker thrust
    means weaker torques.
    """
    cards = [CARDS[e] for e in effects if e in CARDS]
    if name.endswith("_trim"):
        return any(card.trim is not None for card in cards)
    if name.startswith("thrust"):
        return any("motion" in card.scales for card in cards)
    return name.startswith(("inertia", "yaw")) and any("torques" in card.scales for card in cards)


def pictures_of(identification: Identification) -> list[tuple[str, str]]:
    """(axis, gain over phase as SVG) of every axis that was measured."""
    pictures = []
    with rc_context(STYLE):
        for axis, pair in identification.responses.items():
            pictures.append((axis, as_svg(_draw(axis, pair), f"response of {axis}")))
    return pictures


def _draw(axis: str, pair: Pair) -> Figure:
    """Gain and phase of one axis over frequency, measured with 90 % bands beside
    simulated.
    """
    width, height = PANEL
    figure = Figure(figsize=PANEL)
    # inches around and between what is always as large; a layout that is searched for
    # takes as long as the drawing
    figure.subplots_adjust(
        left=0.8 / width,
        right=1.0 - 0.1 / width,
        bottom=0.5 / height,
        top=1.0 - 0.1 / height,
        hspace=0.12,
    )
    gain, phase = figure.subplots(2, 1, sharex=True)
    for response, colour in ((pair.simulated, BEFORE), (pair.measured, AFTER)):
        for axes, values in ((gain, response.gain), (phase, response.phase)):
            low, middle, high = np.array(values).T
            axes.plot(response.frequency, middle, color=colour)
            axes.fill_between(response.frequency, low, high, color=colour, alpha=0.25)
    unit = "m/s²" if axis == "thrust" else "rad/s²"
    gain.set(xscale="log", ylim=(0.0, None), ylabel=f"gain [{unit}]")
    phase.set(xlabel="frequency [Hz]", ylabel="phase [°]")
    phase.set_xticks([1, 2, 5, 10], ["1", "2", "5", "10"])
    phase.xaxis.set_minor_locator(NullLocator())
    for axes in (gain, phase):  # clear of "1000", and within the figure
        axes.yaxis.set_label_coords(-0.55 / (width - 0.9), 0.5)
    return figure
