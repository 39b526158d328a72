"""The steps of a command that takes more than a few seconds: which one runs, and about how long all will still take."""

import time
from collections.abc import Mapping

from rich.console import Console
from rich.progress_bar import ProgressBar
from rich.spinner import Spinner
from rich.table import Table
from rich.text import Text

from openjax.show.progress import duration, live_display

LONG = 30.0
"""Seconds from which a file is told, too."""


class Steps:
    """One line on a terminal; into a file, how long it will take, if that is long. Use as a context manager.

    Args:
      title: what is done.
      expected: {step: seconds on a usual machine}, in the order in which they come. What the steps so far took against
        this tells how long the rest takes here.
      console: where to draw.
    """

    def __init__(self, title: str, expected: Mapping[str, float], console: Console):
        self._title, self._expected, self._console = title, dict(expected), console
        self._total = sum(self._expected.values())
        self._done, self._step, self._note = 0.0, None, ""
        self._start = self._step_start = time.monotonic()
        self._spinner = Spinner("dots")
        self._live = live_display(self._render, console, stays=False)

    def __enter__(self):
        self._live.start()
        if self._total > LONG and not self._console.is_terminal:
            self._console.print(f"{self._title}: about {duration(self._total)} ...", soft_wrap=True)
        return self

    def __exit__(self, *_):
        self._live.stop()

    def begin(self, step: str, note: str = "") -> None:
        """The step before is done, and `step` begins; one that isn't in `expected` takes no time of its own."""
        if step != self._step:
            self._done += self._expected.get(self._step, 0.0)
            self._step, self._step_start = step, time.monotonic()
        self._note = note

    def seconds_left(self, now: float) -> float:
        """Until all steps are done, at time `now` of `time.monotonic`."""
        took = self._step_start - self._start
        slower = took / self._done if self._done > 0 else 1.0
        running = max(slower * self._expected.get(self._step, 0.0) - (now - self._step_start), 0.0)
        later = self._total - self._done - self._expected.get(self._step, 0.0)
        return running + slower * max(later, 0.0)

    def _render(self):
        now = time.monotonic()
        left = self.seconds_left(now)
        done = (now - self._start) / max(now - self._start + left, 1e-6)
        text = f"{self._title}: {self._step or 'starting'}{f' ({self._note})' if self._note else ''}"
        row = Table.grid(padding=(0, 1))
        row.add_row(
            self._spinner,
            Text(text),
            ProgressBar(total=1.0, completed=done, width=24),
            Text(f"about {duration(left)} left", style="dim"),
        )
        return row
