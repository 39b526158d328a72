"""What changed, told: a few sentences, `changes.json`, a page with one figure."""

import json
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from openjax.comparison.causes import CAUSES
from openjax.comparison.figures import FIGURES, TRIMS
from openjax.comparison.result import Change, Interval
from openjax.show.pages import AFTER, BEFORE, GREY, STYLE, as_svg, filled


def prediction(change: Change) -> dict:
    """The case's entry in a predictions file: `probabilities` of no change and of each
    cause add up to one.
    """
    causes = {
        c.replace(" ", "_"): round(change.probability * p, 5)
        for c, p in change.causes.items()
    }
    return {
        "changed": change.changed,
        "effects": list(change.effects),
        "rotors": list(change.rotors) if change.trims_changed else [],
        "side": change.side if change.trims_changed else "",
        "size": round(change.size.value, 4),
        "probabilities": {"no_change": round(1.0 - change.probability, 5)} | causes,
    }


def to_dict(change: Change) -> dict:
    """`changes.json`."""

    def interval(one: Interval) -> dict:
        return {
            "value": round(one.value, 5),
            "interval90": [round(one.low, 5), round(one.high, 5)],
        }

    return prediction(change) | {
        "case": change.name,
        "in_words": in_words(change),
        "least_shown": round(change.least, 4),
        "size90": [round(change.size.low, 4), round(change.size.high, 4)],
        "places": {
            "+".join(map(str, p)) or "unclear": round(v, 4)
            for p, v in change.places.items()
            if v > 5e-4
        },
        "figures": {n: interval(v) for n, v in change.figures.items()},
        "days": {
            "reference": change.days,
            "spread": {n: round(v, 4) for n, v in change.spread.items()},
        },
        "flights": [
            {
                "flight": f.name,
                "set": name,
                "day": f.day.rpartition("/")[2],
                "voltage": f.voltage,
            }
            | {n: round(v[0], 5) for n, v in f.values.items()}
            for name, figures in (
                ("reference", change.reference),
                ("new", change.flights),
            )
            for f in figures
        ],
        "quality": [{"flight": i.flight, "issue": i.issue} for i in change.quality],
    }


def _what_changed(change):
    """Whether something did, by which cause, and how large it is."""
    sentences = list(
        dict.fromkeys(_cause_in_words(change, cause) for cause in change.likely_causes)
    )
    chance = (
        f"probability{'' if change.changed else ' of one:'} {change.probability:.2f}"
    )
    if not change.changed:
        lines = [f"No change that these flights can show ({chance})."]
        lines += [f"Below the spread of days; if anything, {sentences[0]}."] * (
            change.probability > 0.2
        )
    else:
        lines = [f"The vehicle changed ({chance}): {' or '.join(sentences)}."]
    if change.trims_changed:
        value, low, high = (
            100 * v for v in (change.size.value, change.size.low, change.size.high)
        )
        end = " lost." if value > 0 else " (negative: it got stronger or lighter)."
        lines.append(
            f"Size: {value:.0f} % [{low:.0f}, {high:.0f}] of a rotor's thrust{end}"
        )
        if len(sentences) > 1:
            lines.append(
                "These flights can't split the causes named; a weighed vehicle or another "
                "propeller would."
            )
    elif change.changed:
        names = dict.fromkeys(
            n for c in change.likely_causes for n in CAUSES[c].figures
        )
        lines += [
            f"{FIGURES[n].words.capitalize()}: {_difference(n, change.figures[n])}."
            for n in names
            if n in change.figures
        ]
    return lines


def in_words(change: Change) -> list[str]:
    """The answer in a few plain sentences."""
    lines = _what_changed(change)
    if change.charge_unknown:
        lines.append(
            "What may differ is the battery: an emptier one makes less thrust of a duty cycle. Log "
            "vbat, and thrust can be compared."
        )
    differences = ", ".join(
        f"{n} {100 * v.value:+z.1f} % [{100 * v.low:+z.1f}, {100 * v.high:+z.1f}]"
        for n, v in change.figures.items()
        if n in TRIMS
    )
    lines.append(
        f"Trims against the reference, as shares of hover, with the spread of days: {differences}."
    )
    days = f"{change.days} day{'s' * (change.days > 1)}"
    spread = (
        "estimated from them and a prior"
        if change.days > 1
        else "a prior: fly the reference on several days"
    )
    lines.append(
        f"The reference holds {len(change.reference)} flights of {days} (their spread is "
        f"{spread}). A single rotor that "
        f"lost less than {100 * change.least:.0f} % of its thrust would not show."
    )
    return lines


def _cause_in_words(change: Change, cause: str) -> str:
    rotors = " and ".join(str(r) for r in change.rotors)
    more = change.size.value > 0
    weaker = "weaker" if more else "stronger"
    several = len(change.rotors) > 1
    if cause == "one rotor weaker" and several:
        return f"one of rotors {rotors} ({change.side}) is {weaker}"
    if cause.endswith("weaker"):
        return (
            f"rotor{'s' * several} {rotors} ({change.side}) "
            f"{'are' if several else 'is'} {weaker}"
        )
    if cause == "weight":
        beside = (
            f" at the {change.side}"
            if change.side and change.side != "diagonal"
            else ""
        )
        return f"a weight was {'added' if more else 'taken off'}{beside}"
    if cause == "whole vehicle":
        return (
            "the whole vehicle is heavier or its thrust weaker"
            if more
            else "it is lighter or stronger"
        )
    what = CAUSES[cause].what
    return f"the {what} changed" if what else "something without a known pattern"


def _difference(name: str, d: Interval) -> str:
    """ "+12 % [+8, +16]"; see `Figure`."""
    unit = FIGURES[name].unit
    factor = FIGURES[name].factor
    value, low, high = (
        factor * v if factor else 100 * np.expm1(v) for v in (d.value, d.low, d.high)
    )
    return f"{value:+.3g} {unit} [{low:+.3g}, {high:+.3g}]"


def write(change: Change, folder: Path, pictures: bool = True) -> None:
    """`changes.json` and (with `pictures`) `changes.html` into an existing folder."""
    (folder / "changes.json").write_text(
        json.dumps(to_dict(change), indent=1) + "\n", encoding="utf-8"
    )
    if pictures:
        (folder / "changes.html").write_text(html_of(change), encoding="utf-8")


def html_of(change: Change) -> str:
    """One page, nothing to fetch from elsewhere."""
    with rc_context(STYLE):
        picture = as_svg(draw(change), change.name)
    differences = [
        (FIGURES[name].words, _difference(name, d))
        for name, d in change.figures.items()
    ]
    content = {
        "lines": in_words(change),
        "picture": picture,
        "differences": differences,
    }
    return filled("changes.html.jinja", Path(__file__).parent, change=change, **content)


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
                np.full(len(values), place),
                values,
                "o",
                ms=5,
                color=(GREY, BEFORE)[k],
                alpha=0.8,
            )
    middle = _in_percent(change.reference, name, level).mean()
    spread = 100 * change.spread[name]
    axis.axhspan(
        middle - 1.645 * spread,
        middle + 1.645 * spread,
        color=AFTER,
        alpha=0.12,
        lw=0,
    )
    axis.set(
        title=name,
        xticks=(0, 1),
        xticklabels=("reference", "new"),
        xlim=(-0.6, 1.6),
    )


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
        "all" if len(p) == 4 else "+".join(f"m{i}" for i in p) or "no rotor's"
        for p, _ in places
    ]
    shares = [change.probability * share for _, share in places]
    axes[4].barh(
        ["no change", *names][::-1],
        [1 - change.probability, *shares][::-1],
        color=AFTER,
    )
    axes[4].set(title="probability", xlim=(0, 1))
    return figure
