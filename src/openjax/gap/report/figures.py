"""Figures of a report."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context

from openjax.flights.track import smooth, to_body
from openjax.gap.model.library import CARDS
from openjax.gap.model.replay import SKIP
from openjax.gap.model.table import HORIZONS
from openjax.gap.report.report import Report
from openjax.gap.residual import disturbances
from openjax.gap.where import CALM, before_and_after
from openjax.show.pages import AFTER, BEFORE, GREY, STYLE, add_legend, as_svg, small_figure

AHEAD = HORIZONS["velocity"]  # s
BINS = 15
WIDTH = 4.6  # inches, read on a phone as on a desk


def figures(report: Report) -> list[tuple[str, str, str]]:
    """(title, what it shows, SVG) of every figure that the report's arrays allow; a gap
    only where there is one.
    """
    if not report.plots:
        return []
    entries = []
    with rc_context(STYLE):
        for draw in (_places, _course, _coordinate):
            parts = draw(report)
            if parts is not None:
                title, text, figure = parts
                entries.append((title, text, as_svg(figure, title)))
    return entries


def _residuals(report: Report) -> tuple[list, list]:
    """Residuals of each track of the nominal simulator, sensors and clocks as with the
    named effects, and with those.
    """
    fit = report.plots["selection"].fit
    return before_and_after(fit, [e for e in report.named if e in fit.effects])


def _places(report: Report):
    """The parts of the flights that hold most of the gap: error before and after, in
    units of the noise.
    """
    # the largest comes last, as rows are drawn from below
    places = [place for place in report.where if place.share > 0.01][:8][::-1]
    if not report.effects or not places:
        return None
    figure, axes = small_figure((WIDTH, 1.0 + 0.42 * len(places)))
    rows = np.arange(len(places))
    nominal = np.array([place.before for place in places])
    with_effects = np.array([place.after for place in places])
    axes.hlines(rows, with_effects, nominal, color=GREY, linewidth=2)
    axes.plot(nominal, rows, "o", color=BEFORE, markersize=7, label="nominal simulator")
    if report.parameters:
        axes.plot(
            with_effects, rows, "o", color=AFTER, markersize=7, label="with the named effects"
        )
    axes.axvline(1.0, color=GREY, linestyle=":", linewidth=1.2)
    axes.set_yticks(rows, [f"{p.channel}, {p.regime}".replace("_", " ") for p in places])
    axes.set(xlabel="error, in units of the noise", xlim=(0, None), ylim=(-0.6, len(places) - 0.4))
    add_legend(axes)
    return (
        "Where the gap lies",
        (
            f"Forces and torques, averaged over {CALM} s, estimator and firmware, by part of the "
            "flight."
        ),
        figure,
    )


@dataclass(frozen=True, eq=False)
class Course:
    """Errors of one channel of one flight."""

    flight: str
    time: np.ndarray  # (T,) s
    nominal: np.ndarray  # (T,) in `unit`
    with_effects: np.ndarray
    name: str
    unit: str

    @property
    def ratio(self) -> float:
        """By how much the nominal error is larger."""
        return rms(self.nominal) / max(rms(self.with_effects), 1e-12)


def rms(values: Float[np.ndarray, "..."]) -> float:
    """Root of the mean square: a constant error counts whole."""
    return float(np.sqrt(np.mean(np.square(values))))


def _courses(report: Report) -> Iterator[Course]:
    """Every channel of every flight."""
    evidence = report.plots["evidence"]
    yield from _courses_of_motion(report)
    for channel in evidence.channels:
        without = channel.residuals(())
        floor = channel.residuals(evidence.library.of(channel.path))
        for name, series in channel.residuals(report.named).items():
            scale = max(rms(np.concatenate(floor[name])), 1e-12)
            for track, nominal, with_effects in zip(
                evidence.tracks, without[name], series, strict=True
            ):
                # of some channels one number is known of a whole flight
                skip = int(SKIP / track.dt) if len(with_effects) > 1 else 0
                yield Course(
                    flight=track.name,
                    time=track.time[skip:],
                    nominal=np.resize(nominal, len(track))[skip:] / scale,
                    with_effects=np.resize(with_effects, len(track))[skip:] / scale,
                    name="mean motor command" if name == "motors all" else name,
                    unit="times the noise",
                )


def _courses_of_motion(report: Report) -> Iterator[Course]:
    """Errors of short predictions of body rates and velocity of every flight, as far as
    they were logged.
    """
    evidence = report.plots["evidence"]
    nominal, with_effects = _residuals(report)
    axes = [axis for axis in range(6) if evidence.replay.usable[axis]]
    for number, track in enumerate(evidence.tracks):
        step = max(round(AHEAD / track.dt), 1)
        skip = int(SKIP / track.dt)
        for axis in axes:
            name, unit = _axis_name(axis)
            before, after = (r[number][skip:, axis] for r in (nominal, with_effects))
            yield Course(
                flight=track.name,
                time=track.time[skip + step :],
                nominal=before[step:] - before[:-step],
                with_effects=after[step:] - after[:-step],
                name=name,
                unit=unit,
            )


def _axis_name(axis: int) -> tuple[str, str]:
    """The name and unit of an axis of the residuals."""
    if axis >= 3:
        return f"velocity {'xyz'[axis - 3]}", "m/s"
    return f"{('roll', 'pitch', 'yaw')[axis]} rate", "rad/s"


def _course(report: Report):
    """Errors of short predictions along the flight where the nominal simulator errs
    most, against what is left.
    """
    course = max(_courses(report), key=lambda course: course.ratio, default=None)
    if course is None:
        return None
    figure, axes = small_figure((WIDTH, 3.0))
    time = course.time - course.time[0]
    # so many standard deviations hold 90 % of a normal distribution
    band = 1.645 * rms(course.with_effects)
    label = "90 % of what is left" if report.parameters else "90 % of all errors"
    axes.axhspan(-band, band, color=GREY, alpha=0.25, linewidth=0, label=label)
    for error, colour, label in _lines(report, course.nominal, course.with_effects):
        axes.plot(time, error, color=colour, linewidth=1.1, label=label)
    axes.set(
        xlabel="time in the flight [s]",
        ylabel=f"error of {course.name} [{course.unit}]",
        xlim=(time[0], time[-1]),
    )
    add_legend(axes)
    ahead = "" if course.unit == "times the noise" else f" of predictions {AHEAD} s ahead"
    return ("One flight", f"{course.flight}: error of {course.name}{ahead}.", figure)


def _lines(report: Report, nominal, with_effects) -> Sequence[tuple]:
    """(residual, colour, label): the nominal simulator, and the corrected one where
    effects were named.
    """
    if not report.parameters:
        return ((nominal, AFTER if report.verdict == "none" else BEFORE, "nominal simulator"),)
    return (nominal, BEFORE, "nominal simulator"), (with_effects, AFTER, "with the named effects")


def _coordinate(report: Report):
    """The acceleration that the nominal simulator misses, against the variable that the first named
    effect follows.
    """
    evidence = report.plots["evidence"]
    effects = report.named
    if not effects or not evidence.replay.usable[3] or evidence.tracks[0].quaternion is None:
        return None
    coordinate = CARDS[effects[0]].coordinate
    if not coordinate:  # its force follows none, or it makes torques or delays
        return None
    figure, axes = small_figure((WIDTH, 3.0))
    for residuals, (_, colour, label) in zip(
        _residuals(report), _lines(report, None, None), strict=False
    ):
        pairs = []
        for track, residual in zip(evidence.tracks, residuals, strict=True):
            pair = _pairs(track, residual, coordinate)
            if pair is not None:
                pairs.append(pair)
        if not pairs:
            return None
        along, missing = _bin_means(np.concatenate(pairs)).T
        axes.plot(along, missing, "o-", color=colour, markersize=5, label=label)
    units = {
        "body velocity": "forward speed [m/s]",
        "voltage": "voltage [V]",
        "thrust": "mean motor command",
    }
    axes.axhline(0.0, color=GREY, linestyle=":", linewidth=1.2)
    axes.set(
        xlabel=units.get(coordinate, f"{coordinate} [m]"), ylabel="missing acceleration [m/s²]"
    )
    add_legend(axes)
    return (
        "The strongest effect",
        f"{effects[0]}: what the simulator misses, against what drives it.",
        figure,
    )


def _pairs(track, residual, coordinate):
    """(T', 2) of the coordinate and the missing acceleration along its axis; None where
    the track hasn't it.
    """
    missing = smooth(disturbances(track, residual), CALM, track.dt)[:, 3:6]
    # drag acts against the motion, all else along the rotors' axes
    axis = 0 if coordinate == "body velocity" else 2
    along = _along(track, coordinate)
    if along is None:
        return None
    return np.stack([along, missing[:, axis]], 1)[int(SKIP / track.dt) :]


def _along(track, coordinate: str) -> np.ndarray | None:
    """(T,) values of a coordinate along a track; None where the track hasn't it."""
    match coordinate:
        case "body velocity":
            return to_body(track.quaternion, track.velocity)[:, 0]
        case "height":
            return track.position[:, 2]
        case "thrust":
            return smooth(track.motor.mean(1), 0.05, track.dt)
        case "voltage":
            return track.voltage
        case "height below a neighbour" if len(track.neighbours):
            return track.neighbours[0][:, 2] - track.position[:, 2]
    return None


def _bin_means(data: np.ndarray) -> np.ndarray:
    """(B, 2) means over bins of as many samples each."""
    edges = np.quantile(data[:, 0], np.linspace(0, 1, BINS + 1))
    bins = np.clip(np.searchsorted(edges, data[:, 0]) - 1, 0, BINS - 1)
    return np.array([data[bins == b].mean(0) for b in range(BINS) if (bins == b).any()])
