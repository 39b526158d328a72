"""The terminal's view of a run, or of another command that takes its time: a live display, or plain
lines into a file.
"""

import math
import time
from collections.abc import Mapping

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.spinner import Spinner
from rich.table import Table
from rich.text import Text

_SHOWN = {
    "capture_rate": "capture rate",
    "crash_rate": "crash rate",
    "collision_rate": "collision rate",
    "episode_return": "return",
    "prediction_error": "prediction off by [m]",
    "archive_size": "archive size",
}
_LINE_INTERVAL = 5.0  # s between plain lines
LONG = 30.0
"""Seconds from which a file is told, too, how long a command's steps will take."""


class _Display:
    """The output of `_render`, drawn again and again on a terminal while it is entered; into a file
    it draws nothing.
    """

    def __init__(self, console: Console, stays: bool):
        terminal = console.is_terminal
        self._console = console
        self._spinner = Spinner("dots")
        transient = not (stays and terminal)
        self._live = Live(
            get_renderable=self._render, console=console, auto_refresh=terminal, transient=transient
        )

    def __enter__(self):
        self._live.start()
        return self

    def __exit__(self, *_):
        self._live.stop()


class Progress(_Display):
    """Live display of a run. Use as a context manager.

    Args:
      title: what is being run.
      total_steps: environment steps of the whole run.
      console: where to draw; by default standard output.
    """

    def __init__(self, title: str, total_steps: int, console: Console | None = None):
        self._title = title
        self._total = max(total_steps, 1)
        self._phase = "starting"
        self._phase_start = time.monotonic()
        self._steps = 0
        self._rate = 0.0
        self._last = None  # (time, steps) of the last update, for the speed
        self._values: dict[str, float] = {}
        self._validation: dict[str, float] = {}
        self._last_line = 0.0
        # which draws it
        super().__init__(console or Console(highlight=False), stays=True)
        self._lines = not self._console.is_terminal

    def phase(self, text: str, announce: bool = True) -> None:
        """Say what is going on now, for example what is being compiled.

        Where there's no terminal, it's a line of its own if `announce`.
        """
        if text == self._phase:
            return
        self._phase = text
        self._phase_start = time.monotonic()
        self._last = None  # the speed is that of training alone
        self._last_line = self._phase_start
        if self._lines and announce:
            self.message(f"{text} ...")

    def message(self, text: str) -> None:
        """A line that stays."""
        self._console.print(Text(text), soft_wrap=True)
        self._console.file.flush()

    def update(self, steps: int, values: dict[str, float]) -> None:
        """One training update is done.

        Args:
          steps: environment steps so far.
          values: its metrics; those known to the display are shown.
        """
        time_read = time.monotonic()
        if self._last is not None and time_read > self._last[0]:
            rate = (steps - self._last[1]) / (time_read - self._last[0])
            # a running mean: single updates are uneven
            self._rate = rate if self._rate == 0.0 else 0.9 * self._rate + 0.1 * rate
        self._last = (time_read, steps)
        self._steps = steps
        self._values = values
        if self._lines and time_read - self._last_line > _LINE_INTERVAL:
            self._last_line = time_read
            self.message(f"{self._speed()} | {_list(values)}")

    def validation(self, values: dict[str, float], is_best: bool) -> None:
        """Result of an evaluation on the validation tasks."""
        self._validation = values
        if self._lines:
            remark = " (best so far)" if is_best else ""
            self.message(f"validation tasks: {_list(values)}{remark}")

    def _speed(self):
        share = f"{100 * min(self._steps / self._total, 1):.0f} %, {_count(self._steps)} steps"
        if self._rate == 0.0:  # a speed takes two updates
            return share
        seconds = max(self._total - self._steps, 0) / self._rate
        return f"{share}, {_count(self._rate)} steps/s, {duration(seconds)} left"

    def _render(self):
        seconds = time.monotonic() - self._phase_start
        self._spinner.update(text=Text(f"{self._phase}  {seconds:.0f} s"))
        rows = [
            self._spinner,
            ProgressBar(total=self._total, completed=self._steps),
            Text(self._speed()),
        ]
        if self._values or self._validation:
            table = Table.grid(padding=(0, 3))
            table.add_row(
                "", Text("training", style="bold"), Text("validation tasks", style="bold")
            )
            training = _labels(self._values)
            validation = _labels(self._validation)
            for label in _SHOWN.values():
                if label in training or label in validation:
                    table.add_row(Text(label), training.get(label, ""), validation.get(label, ""))
            rows.append(table)
        return Panel(Group(*rows), title=self._title, title_align="left")


def _labels(values):
    """Those that are shown, as text by their labels."""
    texts = {}
    for name, label in _SHOWN.items():
        if name in values:
            value = values[name]
            is_number = value is not None and not math.isnan(value)
            texts[label] = f"{value:.3g}" if is_number else "–"
    return texts


def _list(values):
    """The same in a line."""
    return ", ".join(f"{label} {value}" for label, value in _labels(values).items())


def _count(value):
    for unit, size in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if value >= size:
            return f"{value / size:.3g} {unit}"
    return f"{value:.0f}"


def duration(seconds: float) -> str:
    """Minutes and seconds, 3:02, and hours where there are any."""
    minutes, seconds = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{seconds:02d}" if hours else f"{minutes}:{seconds:02d}"


class Steps(_Display):
    """One line on a terminal; into a file, how long it will take, if that is long. Use
    as a context manager.

    Args:
      title: what is done.
      durations: {step: seconds on a usual machine}, in the order in which they come.
        What the steps so far took against this tells how long the rest takes here.
      console: where to draw.
    """

    def __init__(self, title: str, durations: Mapping[str, float], console: Console):
        self._title = title
        self._durations = dict(durations)
        self._total = sum(self._durations.values())
        self._done = 0.0
        self._step = None
        self._note = ""
        self._start = self._step_start = time.monotonic()
        super().__init__(console, stays=False)  # which draws it

    def __enter__(self):
        if self._total > LONG and not self._console.is_terminal:
            self._console.print(f"{self._title}: about {duration(self._total)} ...", soft_wrap=True)
        return super().__enter__()

    def begin(self, step: str, note: str = "") -> None:
        """The step before is done, and `step` begins; one that isn't in `durations`
        takes no time of its own. Into a file, a long step is told, and each of its notes.
        """
        is_other = step != self._step
        if is_other:
            self._done += self._durations.get(self._step, 0.0)
            self._step = step
            self._step_start = time.monotonic()
        is_told = self._durations.get(step, 0.0) > LONG and (is_other or note != self._note)
        self._note = note
        if is_told and not self._console.is_terminal:
            seconds = self.seconds_left(time.monotonic())
            line = f"{self._text()}, about {duration(seconds)} left"
            self._console.print(Text(line), soft_wrap=True)
            self._console.file.flush()

    def _text(self):
        text = f"{self._title}: {self._step or 'starting'}"
        return f"{text} ({self._note})" if self._note else text

    def seconds_left(self, moment: float) -> float:
        """Until all steps are done, at a moment of `time.monotonic`."""
        took = self._step_start - self._start
        # as much slower than the usual machine as the steps so far were
        slower = took / self._done if self._done > 0 else 1.0
        step = self._durations.get(self._step, 0.0)
        in_step = max(slower * step - (moment - self._step_start), 0.0)
        steps_left = self._total - self._done - step
        return in_step + slower * max(steps_left, 0.0)

    def _render(self):
        time_read = time.monotonic()
        seconds = self.seconds_left(time_read)
        share = (time_read - self._start) / max(time_read - self._start + seconds, 1e-6)
        row = Table.grid(padding=(0, 1))
        row.add_row(
            self._spinner,
            Text(self._text()),
            ProgressBar(total=1.0, completed=share, width=24),
            Text(f"about {duration(seconds)} left", style="dim"),
        )
        return row
