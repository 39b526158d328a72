"""Log variables of the Crazyflie's firmware, wherever they were written down: on the card, by the
client or cflib, or in a topic of Crazyswarm2.
"""

from pathlib import Path

import numpy as np

from openjax.files import read_toml
from openjax.flights.importers.columns import ColumnMapping, Source, source_of
from openjax.flights.importers.streams import Stream

_FILE = Path(__file__).with_name("firmware.toml")
FIRMWARE_SOURCES = {
    column: [source_of(column, entry, _FILE) for entry in entries]
    for column, entries in read_toml(_FILE).items()
}
"""Log variables of the firmware that hold each column, best first."""
MIXER_INPUTS = tuple(f"controller.cmd_{name}" for name in ("thrust", "roll", "pitch", "yaw"))
VARIABLES = frozenset(
    source.name for sources in FIRMWARE_SOURCES.values() for source in sources
) | set(MIXER_INPUTS)
"""All that are read."""
MIXED = "no motor commands were logged: they are made from the mixer's inputs"


def firmware_columns(
    streams: list[Stream], mapping: ColumnMapping | None = None
) -> tuple[dict[str, Source], list[str]]:
    """The columns that streams of log variables hold, what a `columns.toml` says before
    what is usual, and remarks.
    """
    names = {name for stream in streams for name in stream.values}
    present = {
        column: next((source for source in sources if source.name in names), None)
        for column, sources in FIRMWARE_SOURCES.items()
    }
    columns = {column: source for column, source in present.items() if source is not None}
    remarks = []
    if mapping is not None:
        columns = mapping.over(columns)
        absent = [source.name for source in columns.values() if source.name not in names]
        remarks += [f"no log variable {name!r}" for name in absent]
    if columns.get("m1", Source("")).name == "mixer.m1":
        remarks.append(MIXED)
    return columns, remarks


def are_duty_cycles(columns: dict[str, Source]) -> bool:
    """True if the motors' columns are what the firmware's motors got: duty cycles, behind
    the battery compensation. The mixer's outputs are before it.
    """
    return columns.get("m1", Source("")).name in ("motor.m1", "pwm.m1_pwm")


def with_mixer(stream: Stream) -> Stream:
    """The stream with `mixer.m1` to `mixer.m4`, 0 to 65535, where it holds the mixer's
    four inputs: what the firmware's legacy power distribution
    (power_distribution_quadrotor.c) makes of them, before the battery compensation.
    """
    inputs = [stream.values.get(name) for name in MIXER_INPUTS]
    if any(values is None for values in inputs):
        return stream
    thrust = inputs[0]
    roll = inputs[1] / 2
    pitch = inputs[2] / 2
    yaw = inputs[3]
    motors = (thrust - roll + pitch + yaw, thrust - roll - pitch - yaw,
              thrust + roll - pitch + yaw, thrust + roll + pitch - yaw)  # fmt: skip
    outputs = {f"mixer.m{i}": np.clip(m, 0.0, 65535.0) for i, m in enumerate(motors, 1)}
    return Stream(stream.time, stream.values | outputs)
