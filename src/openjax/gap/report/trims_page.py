"""The trims of two sets of flights on a page: every flight, day by day, and where the
change would sit.
"""

from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from openjax.gap.trims.change import Change, difference_in_words
from openjax.gap.trims.figures import FIGURES, TRIMS
from openjax.show.pages import AFTER, BEFORE, GREY, STYLE, as_svg, fill_template


def content_of(change: Change) -> dict:
    """What `trims.html.jinja` shows of it."""
    with rc_context(STYLE):
        picture = as_svg(draw(change), change.name)
    differences = [
        (FIGURES[name].words, difference_in_words(name, d)) for name, d in change.figures.items()
    ]
    return {"lines": change.in_words(), "picture": picture, "differences": differences}


def page_of_trims(change: Change) -> str:
    """The page of flights that show no more than trims; nothing to fetch from
    elsewhere.
    """
    folder = Path(__file__).parent
    trims = content_of(change)
    return fill_template("trims_page.html.jinja", folder, change=change, trims=trims)


def _in_percent(flights, name, level):
    """(F,) a trim of each flight in percent of a hover; of the hover itself what it
    differs from the usual one, `level`.
    """
    values = np.array([flight.values[name][0] for flight in flights])
    return 100 * (values / level - 1.0 if name == "hover" else values)


def _draw_trim(axis, change, name, level):
    """A trim of every flight, day by day, on the band of normal days."""
    for k, figures in enumerate((change.reference, change.flights)):
        days = list(dict.fromkeys(f.day for f in figures))
        for j, day in enumerate(days):
            of_day = [f for f in figures if f.day == day]
            values = _in_percent(of_day, name, level)
            place = k + 0.6 * ((j + 0.5) / len(days) - 0.5)
            axis.plot(
                np.full(len(values), place), values, "o", ms=5, color=(GREY, BEFORE)[k], alpha=0.8
            )
    middle = _in_percent(change.reference, name, level).mean()
    spread = 100 * change.spread[name]
    axis.axhspan(middle - 1.645 * spread, middle + 1.645 * spread, color=AFTER, alpha=0.12, lw=0)
    axis.set(title=name, xticks=(0, 1), xticklabels=("reference", "new"), xlim=(-0.6, 1.6))


def draw(change: Change):
    """Trims of every flight, day by day, beside what days differ by; and where the
    change would sit.
    """
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    axes = figure.subplots(1, 5, width_ratios=(1, 1, 1, 1, 1.3))
    level = np.mean([f.values["hover"][0] for f in change.reference])
    for axis, name in zip(axes, TRIMS, strict=False):
        _draw_trim(axis, change, name, level)
    axes[0].set_ylabel("% of hover (band: 90 % of normal days)")
    places = sorted(change.places.items(), key=lambda item: -item[1])[:6]
    names = [
        "all" if len(p) == 4 else "+".join(f"m{i}" for i in p) or "no rotor's" for p, _ in places
    ]
    shares = [change.probability * share for _, share in places]
    axes[4].barh(["no change", *names][::-1], [1 - change.probability, *shares][::-1], color=AFTER)
    axes[4].set(title="probability", xlim=(0, 1))
    return figure
