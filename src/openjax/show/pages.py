"""Pages in one file, nothing to fetch from elsewhere, with figures in SVG that take
their colours from the page.
"""

import io
import re
from pathlib import Path

import jinja2
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

# both stand out on white and on black
BEFORE = "#d1495b"
AFTER = "#2e86ab"
GREY = "#8a8f98"
INK = "#0a0b0c"  # becomes the page's text colour
STYLE = {
    "svg.fonttype": "none",
    "savefig.transparent": True,
    "font.family": "sans-serif",
    "font.size": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    **dict.fromkeys(
        ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), INK
    ),
}


def fill_template(template: str, folder: Path, **values) -> str:
    """A template of a folder with its values and the pages' looks."""
    loader = jinja2.FileSystemLoader([folder, Path(__file__).parent])
    # escaped, as names come from people's files; a name that is missing is an error,
    # not a gap
    environment = jinja2.Environment(
        loader=loader, autoescape=True, undefined=jinja2.StrictUndefined
    )
    page = environment.get_template(template).render(**values)
    # a number and its sign stay on one line
    return re.sub(r"(?<=\d) %", "\u00a0%", page)


def small_figure(size: tuple[float, float]) -> tuple[Figure, Axes]:
    """A figure of one panel; width and height in inches."""
    figure = Figure(figsize=size, layout="constrained")
    return figure, figure.subplots()


def add_legend(axes: Axes) -> None:
    """Above the axes, over the figure's whole width, where it covers nothing."""
    axes.figure.legend(loc="outside upper left", ncols=2, fontsize=10, columnspacing=1.2)


def as_svg(figure: Figure, salt: str) -> str:
    """The figure as an element for a page: text stays text, ink takes the page's
    colour, sizes are the page's.
    """
    data = io.StringIO()
    # without salt and date the same figure would be another file each time
    with rc_context({"svg.hashsalt": salt}):
        figure.savefig(data, format="svg", metadata={"Date": None, "Creator": None})
    text = data.getvalue()
    # without the XML declaration, which only a file of its own has
    text = text[text.index("<svg") :].replace(INK, "currentColor")
    return re.sub(r'<svg ([^>]*?)height="[^"]*"([^>]*?)width="[^"]*"', r"<svg \1\2", text, count=1)
