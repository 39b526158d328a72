"""The trims of two sets of flights on a page: every flight, day by day, and where the
change would sit.
"""

from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes

from openjax.gap.trims.change import Change, difference_in_words
from openjax.gap.trims.figures import FIGURES, TRIMS
from openjax.show.pages import AFTER, BEFORE, GREY, STYLE, as_svg, fill_template, small_figure

PANEL = (2.6, 2.2)  # inches


def content_of(change: Change, lines: list[str], answers: bool) -> dict:
    """The contents of `trims.html.jinja`, with the sentences `lines`. With `answers` it shows the
    probabilities of places, too.
    """
    level = np.mean([f.values["hover"][0] for f in change.reference])
    pictures = []
    with rc_context(STYLE):
        for name in TRIMS:
            figure, axes = small_figure(PANEL)
            draw_trim(axes, change, name, level)
            pictures.append((name, as_svg(figure, f"{change.name} {name}")))
        if answers:
            figure, axes = small_figure(PANEL)
            draw_places(axes, change)
            pictures.append(("probability", as_svg(figure, change.name)))
    differences = [
        (FIGURES[name].words, difference_in_words(name, d)) for name, d in change.figures.items()
    ]
    return {"lines": lines, "pictures": pictures, "differences": differences}


def page_of_trims(change: Change) -> str:
    """The page of flights that show no more than trims; nothing to fetch from
    elsewhere.
    """
    return fill_template(
        "trims_page.html.jinja",
        Path(__file__).parent,
        title=f"What changed: {change.name}",
        change=change,
        trims=content_of(change, change.in_words()[1:], answers=True),
    )


def _in_percent(flights, name, level):
    """(F,) a trim of each flight in percent of a hover; of the hover itself what it
    differs from the usual one, `level`.
    """
    values = np.array([flight.values[name][0] for flight in flights])
    return 100 * (values / level - 1.0 if name == "hover" else values)


def draw_trim(axes: Axes, change: Change, name: str, level: float) -> None:
    """A trim of every flight, day by day, on the band of normal days."""
    for k, figures in enumerate((change.reference, change.flights)):
        days = list(dict.fromkeys(f.day for f in figures))
        for j, day in enumerate(days):
            of_day = [f for f in figures if f.day == day]
            values = _in_percent(of_day, name, level)
            place = k + 0.6 * ((j + 0.5) / len(days) - 0.5)
            axes.plot(
                np.full(len(values), place), values, "o", ms=5, color=(GREY, BEFORE)[k], alpha=0.8
            )
    middle = _in_percent(change.reference, name, level).mean()
    spread = 100 * change.spread[name]
    axes.axhspan(middle - 1.645 * spread, middle + 1.645 * spread, color=AFTER, alpha=0.12, lw=0)
    axes.set(xticks=(0, 1), xticklabels=("reference", "new"), xlim=(-0.6, 1.6))


def draw_places(axes: Axes, change: Change) -> None:
    """Draw the probabilities of no change and of each place of one."""
    places = sorted(change.places.items(), key=lambda item: -item[1])[:6]
    names = [
        "all" if len(p) == 4 else "+".join(f"m{i}" for i in p) or "no rotor's" for p, _ in places
    ]
    shares = [change.probability * share for _, share in places]
    axes.barh(["no change", *names][::-1], [1 - change.probability, *shares][::-1], color=AFTER)
    axes.set(xlim=(0, 1))
