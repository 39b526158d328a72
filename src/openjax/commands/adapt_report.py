"""The report of `openjax adapt`: in lines for a terminal, and as a page."""

from collections.abc import Mapping, Sequence
from pathlib import Path

FIGURES = ("capture_rate", "capture_step", "collision_rate", "crash_rate", "over_speed_rate")
"""Of episodes, in the order in which they are told."""
WHICH = ("nominal", "before", "after")
"""Whose: the policy's as it was, with the nominal and with the diagnosed vehicle, and
the adapted policy's with that one.
"""

RATES = {
    "crashes_from_starts": "crashes from leaning starts (smooth)",
    "crashes_in_flight": "crashes within flights (smooth)",
    "off_the_nominal_flight": "distance from nominal flights",
}
"""Pictures of the page."""
PANEL = (3.4, 2.6)  # inches


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
        f"{name.replace('_', ' ')} {100 * share:.0f} %"
        for name, share in results["won_back"].items()
        if share is not None
    ]
    gain = "The loss on this vehicle is within chance."
    if gains:
        gain = f"Won back of the loss on this vehicle: {', '.join(gains)}."
    return [
        f"Found: {effects}.",
        f"On {results['episodes']} tasks that neither policy was trained on, with the nominal "
        f"vehicle → with the diagnosed vehicles → with these after adapting: {'; '.join(changes)}.",
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
        "pictures": pictures_of(results["history"]),
    }
    return fill_template("adapt.html.jinja", Path(__file__).parent, results=results, **values)


def pictures_of(history: Sequence[Mapping[str, float]]) -> list[tuple[str, str]]:
    """(title, SVG) of each rate over the updates, which a phone shows one below another."""
    from matplotlib import rc_context

    from openjax.show.pages import STYLE, as_svg, small_figure

    pictures = []
    with rc_context(STYLE):
        for name, title in RATES.items():
            figure, axes = small_figure(PANEL)
            axes.plot(range(1, len(history) + 1), [row[name] for row in history])
            axes.set(xlabel="update", ylim=(0, None))
            pictures.append((title, as_svg(figure, title)))
    return pictures
