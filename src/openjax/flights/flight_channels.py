"""Logged flights as channels of an MCAP file: where the vehicle is, and every number
that was logged, to be plotted.
"""

import numpy as np

from openjax.flights.flight import CHANNEL_COLUMNS, Flight
from openjax.show.foxglove import Topic, pose_channel


def flight_channels(flight: Flight) -> list[Topic]:
    """The pose of a flight where it was logged, and its rows under the names of the log
    format; what wasn't sampled at a row is left out.
    """
    name = f"/{flight.name.split('.')[0]}/{flight.vehicle}"
    columns = {}
    for channel, names in CHANNEL_COLUMNS.items():
        values = getattr(flight, channel)
        if values is not None:
            columns |= dict(zip(names, values.reshape(len(flight), -1).T, strict=True))
    rows = [
        (float(time), {n: float(v[k]) for n, v in columns.items() if np.isfinite(v[k])})
        for k, time in enumerate(flight.time)
    ]
    channels = [Topic(f"{name}/log", "openjax.LogRow", rows)]
    if flight.position is not None:
        channels.append(
            pose_channel(f"{name}/pose", flight.time, flight.position, flight.quaternion)
        )
    return channels
