"""What a run shows on the terminal from its first second on: a live panel, or plain lines into a file."""

import time
from collections.abc import Callable

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


def live_display(render: Callable, console: Console, stays: bool) -> Live:
    """What `render` returns, drawn again and again on a terminal; into a file it draws nothing."""
    terminal = console.is_terminal
    transient = not (stays and terminal)
    return Live(get_renderable=render, console=console, auto_refresh=terminal, transient=transient)


class Progress:
    """Live display of a run. Use as a context manager.

    Args:
      title: what is being run.
      total_steps: environment steps of the whole run.
      console: where to draw; by default standard output.
    """

    def __init__(self, title: str, total_steps: int, console: Console | None = None):
        self._console = console or Console(highlight=False)
        self._title = title
        self._total = max(total_steps, 1)
        self._phase, self._phase_start = "starting", time.monotonic()
        self._steps = 0
        self._rate = 0.0
        self._last = None  # (time, steps) of the last update, for the speed
        self._values: dict[str, float] = {}
        self._validation: dict[str, float] = {}
        self._last_line = 0.0
        self._lines = not self._console.is_terminal
        self._spinner = Spinner("dots", text="")
        self._live = live_display(self._render, self._console, stays=True)

    def __enter__(self):
        self._live.start()
        return self

    def __exit__(self, *_):
        self._live.stop()

    def phase(self, text: str, announce: bool = True) -> None:
        """Say what is going on now, for example what is being compiled.

        Where there's no terminal, it's a line of its own if `announce`.
        """
        if text == self._phase:
            return
        self._phase, self._phase_start = text, time.monotonic()
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
        now = time.monotonic()
        if self._last is not None and now > self._last[0]:
            rate = (steps - self._last[1]) / (now - self._last[0])
            self._rate = rate if self._rate == 0.0 else 0.9 * self._rate + 0.1 * rate
        self._last = (now, steps)
        self._steps, self._values = steps, values
        if self._lines and now - self._last_line > _LINE_INTERVAL:
            self._last_line = now
            shown = ", ".join(f"{label} {value}" for label, value in _shown(values).items())
            self.message(f"{self._speed()} | {shown}")

    def validation(self, values: dict[str, float], is_best: bool) -> None:
        """Result of an evaluation on the validation tasks."""
        self._validation = values
        if self._lines:
            shown = ", ".join(f"{label} {value}" for label, value in _shown(values).items())
            self.message(f"validation tasks: {shown}{' (best so far)' if is_best else ''}")

    def _speed(self):
        done = f"{100 * min(self._steps / self._total, 1):.0f} %, {_count(self._steps)} steps"
        if self._rate == 0.0:  # a speed takes two updates
            return done
        left = max(self._total - self._steps, 0) / self._rate
        return f"{done}, {_count(self._rate)} steps/s, {duration(left)} left"

    def _render(self):
        seconds = time.monotonic() - self._phase_start
        self._spinner.update(text=Text(f"{self._phase}  {seconds:.0f} s"))
        rows = [self._spinner, ProgressBar(total=self._total, completed=self._steps), Text(self._speed())]
        if self._values or self._validation:
            table = Table.grid(padding=(0, 3))
            table.add_row("", Text("training", style="bold"), Text("validation tasks", style="bold"))
            training, validation = _shown(self._values), _shown(self._validation)
            for label in _SHOWN.values():
                if label in training or label in validation:
                    table.add_row(Text(label), training.get(label, ""), validation.get(label, ""))
            rows.append(table)
        return Panel(Group(*rows), title=self._title, title_align="left")


def _shown(values):
    """Those that are shown, as text by their labels."""
    known = {label: values[name] for name, label in _SHOWN.items() if name in values}
    return {
        label: "–" if value is None or value != value else f"{value:.3g}" for label, value in known.items()
    }


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
