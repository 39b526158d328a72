"""The report of `openjax adapt`: in lines for a terminal, and as a page."""

from pathlib import Path

FIGURES = ("capture_rate", "capture_step", "collision_rate", "crash_rate", "over_speed_rate")
"""Of episodes, in the order in which they are told."""
WHICH = ("nominal", "before", "after")
"""Whose: the policy's as it was, with the nominal and with the diagnosed vehicle, and
the adapted policy's with that one.
"""


def in_words(results: dict) -> list[str]:
    """The findings and the gain, in words."""
    effects = (
        ", ".join(results["effects"]) or "no effect: the simulator is right to within the noise"
    )
    changes = []
    for name in FIGURES:
        course = " → ".join(f"{results[which][name]:.3g}" for which in WHICH)
        changes.append(f"{name.replace('_', ' ')} {course}")
    gains = [
        f"{name.replace('_', ' ')} {share:.0%}"
        for name, share in results["won_back"].items()
        if share is not None
    ]
    gain = "What the vehicle costs is within chance."
    if gains:
        gain = f"Won back of what the vehicle costs: {', '.join(gains)}."
    return [
        f"Found: {effects}.",
        f"On {results['episodes']} tasks that neither was trained on, with the nominal vehicle → "
        f"with vehicles drawn from what was found, before → after: {'; '.join(changes)}.",
        gain,
        f"Kept: {results['kept']}. {results['seconds']['measured']:.0f} s.",
    ]


def page(results: dict) -> str:
    """One self-contained HTML page."""
    # with matplotlib: not before the compiler has begun
    from openjax.show.pages import fill_template

    values = {
        "words": in_words(results),
        "figures": FIGURES,
        "which": WHICH,
        "picture": _picture(results),
    }
    return fill_template("adapt.html.jinja", Path(__file__).parent, results=results, **values)


def _picture(results):
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    from openjax.show.pages import STYLE, as_svg

    rates = {
        "crashes_from_starts": "crashes from leaning starts (smooth)",
        "crashes_in_flight": "crashes within flights (smooth)",
        "off_the_nominal_flight": "distance from nominal flights",
    }
    with rc_context(STYLE):
        figure = Figure(figsize=(11, 3.2), layout="constrained")
        for axes, (name, title) in zip(figure.subplots(1, len(rates)), rates.items(), strict=True):
            course = [row[name] for row in results["history"]]
            axes.plot(range(1, len(course) + 1), course)
            axes.set(title=title, xlabel="update", ylim=(0, None))
        return as_svg(figure, results["policy"])
