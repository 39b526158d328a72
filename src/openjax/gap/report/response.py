"""The first half of a report: what the vehicle does, beside the simulator."""

import numpy as np
from matplotlib import rc_context

from openjax.gap.identification.quantities import Identification
from openjax.show.pages import AFTER, BEFORE, STYLE, as_svg

TITLE = "What the vehicle does"
WORDS = {
    "spin_up": "time constant of speeding up",
    "spin_down": "time constant of slowing down",
    "delay": "delay of the motors",
    "damping": "damping of roll and pitch",
    "yaw_damping": "damping of yaw",
    "inertia_roll": "inertia about x, as a multiple",
    "inertia_pitch": "inertia about y, as a multiple",
    "yaw_ratio": "torque over inertia about z, as a multiple",
    "thrust_level": "thrust, as a multiple",
    "thrust_slope": "thrust's slope, as a multiple",
    "sag": "thrust per volt of the battery",
    "drag_xy": "drag in the rotor plane",
    "drag_z": "drag along the rotor axes",
    "roll_trim": "trim of roll, share of the thrust",
    "pitch_trim": "trim of pitch, share of the thrust",
    "yaw_trim": "trim of yaw, share of the thrust",
}


def response_of(identification: Identification | None) -> dict | None:
    """Sentence, remarks, rows of numbers and the picture (SVG) for the page; None
    without.
    """
    if identification is None:
        return None
    rows = [
        {
            "name": WORDS.get(name, name.replace("_", " ")),
            "value": f"{q.value:.3g}",
            "interval": f"{q.interval90[0]:.3g} … {q.interval90[1]:.3g}",
            "simulator": f"{q.simulator:.3g}",
            "unit": "" if q.unit == "1" else q.unit,
            "differs": q.differs,
        }
        for name, q in identification.quantities.items()
    ]
    return {
        "sentence": identification.sentence(),
        "remarks": identification.remarks,
        "rows": rows,
        "picture": _picture(identification),
    }


def _picture(identification: Identification) -> str:
    """Gain and phase of every axis over frequency, measured with 90 % bands beside
    simulated.
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullLocator

    with rc_context(STYLE):
        count = len(identification.responses)
        width = 2.6 * count
        figure = Figure(figsize=(width, 4.2))
        # inches around and between what is always as large; a layout that is searched
        # for takes as long as the drawing
        figure.subplots_adjust(
            left=0.75 / width,
            right=1.0 - 0.1 / width,
            bottom=0.5 / 4.2,
            top=1.0 - 0.65 / 4.2,
            wspace=0.3,
            hspace=0.12,
        )
        grid = figure.subplots(2, count, sharex=True, squeeze=False)
        for column, (axis, pair) in enumerate(identification.responses.items()):
            lines = (
                (pair.simulated, BEFORE, "nominal simulator"),
                (pair.measured, AFTER, "measured"),
            )
            for response, color, name in lines:
                for row, values in enumerate((response.gain, response.phase)):
                    low, middle, high = np.array(values).T
                    axes = grid[row, column]
                    axes.plot(response.frequency, middle, color=color, label=name)
                    axes.fill_between(response.frequency, low, high, color=color, alpha=0.25)
            unit = "m/s² per unit" if axis == "thrust" else "rad/s² per unit"
            grid[0, column].set(title=axis, xscale="log", ylim=(0.0, None))
            grid[1, column].set(xlabel="frequency, Hz")
            if axis in ("roll", "thrust"):
                grid[0, column].set(ylabel=unit)
                grid[1, column].set(ylabel="phase, °")
            grid[1, column].set_xticks([1, 2, 5, 10], ["1", "2", "5", "10"])
            grid[1, column].xaxis.set_minor_locator(NullLocator())
        figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="upper left", ncols=2)
        return as_svg(figure, TITLE)
