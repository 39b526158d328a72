"""Pages are read on a phone: figures keep their letters, and nothing is wider than 400 pixels."""

import dataclasses
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from matplotlib import rc_context

from openjax.commands import adapt_report
from openjax.gap.identification.responses import Response
from openjax.gap.report import figures, response, trims_page
from openjax.gap.report.fleet import member_of, page_of_fleet
from openjax.gap.report.page import page_of
from openjax.show.pages import STYLE, add_legend, as_svg, small_figure
from tests.gap.made_reports import change, identification, report

EXTRA = Path(__file__).parents[2] / "docs" / "extra"
PHONE = 400
PADDING = 4 * 0.8 * 16  # pixels: both sides of the page and of a card, in style.css
LEAST = 10.0  # pixels of a letter's height


@pytest.mark.parametrize(
    "size", [(figures.WIDTH, 3.0), response.PANEL, trims_page.PANEL, adapt_report.PANEL], ids=str
)
def test_letters_of_figures_are_read_at_400_pixels(size):
    with rc_context(STYLE):
        figure, axes = small_figure(size)
        axes.plot([0, 1], label="nominal simulator")
        axes.set(xlabel="time in the flight [s]")
        add_legend(axes)
        svg = as_svg(figure, "phone")
    width = float(re.search(r'viewBox="0 0 ([\d.]+) ', svg).group(1))
    letters = [float(found) for found in re.findall(r"font(?:-size)?: (?:\w+ )*([\d.]+)px", svg)]
    assert letters and min(letters) * (PHONE - PADDING) / width >= LEAST


def test_labels_of_a_response_lie_within_the_figure():
    pair = identification().responses["roll"]
    wide = Response("roll", (1.0, 10.0), ((1.0, 1500.0, 2000.0),) * 2, ((-190.0, -150.0, 0.0),) * 2)
    with rc_context(STYLE):
        figure = response._draw("roll", dataclasses.replace(pair, measured=wide))
        figure.canvas.draw()
    for axes in figure.axes:
        label = axes.yaxis.label.get_window_extent()
        assert label.x0 >= 0.0
        assert all(label.x1 <= tick.get_window_extent().x0 for tick in axes.get_yticklabels())


def pages():
    """A report with all its parts, one of several vehicles, and the site's replay and map."""
    full = report(("rotor_drag", "unknown"), "effect", before=4.0)
    full = dataclasses.replace(
        full, identification=identification(lag=0.049), trims=change(0.2), reference="Since Monday."
    )
    other = dataclasses.replace(report(), identification=identification())
    rates = dict.fromkeys(adapt_report.FIGURES, 0.123)
    adapted = {
        "effects": ["rotor_drag"],
        **dict.fromkeys(adapt_report.WHICH, rates),
        "won_back": {"crash_rate": 0.8},
        "history": [dict.fromkeys(adapt_report.RATES, 0.1)] * 2,
        "parameters": [{"parameter": "rotor_drag.d_xy", "value": 0.01, "low": 0.0, "high": 0.02}],
        "episodes": 100,
        "kept": "the adapted policy, which is better",
        "seconds": {"diagnosed": 10.0, "measured": 60.0},
        "command": "openjax adapt flights/my_drone --policy flight --out adapted",
    }
    return {
        "report": page_of(full),
        "adapted": adapt_report.page(adapted),
        "vehicles": page_of_fleet([member_of("cf1", full), member_of("cf2", other)]),
        "replay": (EXTRA / "replay" / "chase.html").read_text(encoding="utf-8"),
        "map": (EXTRA / "map" / "catch.html").read_text(encoding="utf-8"),
    }


@pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium on this machine")
@pytest.mark.parametrize("name", ["report", "vehicles", "adapted", "replay", "map"])
def test_no_page_is_wider_than_a_phone(name, tmp_path):
    """In a frame, as a browser's own window is never that narrow; tables scroll by themselves."""
    (tmp_path / "page.html").write_text(pages()[name], encoding="utf-8")
    measure = "document.title = this.contentDocument.documentElement.scrollWidth"
    frame = f'<iframe src="page.html" style="width: {PHONE}px; border: 0" onload="{measure}">'
    (tmp_path / "frame.html").write_text(f"<!doctype html><title></title>{frame}</iframe>")
    command = "chromium --headless --no-sandbox --disable-gpu --no-first-run --dump-dom".split()
    command += ["--allow-file-access-from-files", f"--user-data-dir={tmp_path / 'profile'}"]
    command.append((tmp_path / "frame.html").as_uri())
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=240)
    (width,) = re.findall(r"<title>(\d+)</title>", done.stdout)
    assert int(width) <= PHONE
