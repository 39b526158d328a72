"""Garbage is called garbage: logs whose channels contradict each other are refused with the numbers. That good
flights pass is tested with the other checks."""

import numpy as np
import pytest

from openjax.flights.checks import check_flight
from openjax.flights.reading import CHANNEL_COLUMNS, LogTable, flights_of
from openjax.vehicle import load_vehicle

VEHICLE = load_vehicle()


def refusals(columns):
    (flight,), _ = flights_of(LogTable("flight.csv", columns, np.full(len(columns["t"]), "0")))
    kept, issues = check_flight(flight, VEHICLE)
    return kept, [i for i in issues if i.refused]


@pytest.mark.parametrize("channel", [c for c in CHANNEL_COLUMNS if c != "battery_voltage"])
@pytest.mark.parametrize("how", ["shuffled", "of another time", "noise"])
def test_a_channel_that_contradicts_the_others_is_garbage(channel, how, sample_columns):
    columns = sample_columns["flight_b"]
    rng, rows = np.random.default_rng(1), len(columns["t"])
    order = rng.permutation(rows) if how == "shuffled" else np.roll(np.arange(rows), rows // 3)
    changed = dict(columns)
    for name in CHANNEL_COLUMNS[channel]:
        changed[name] = columns[name][order]
        if how == "noise":
            changed[name] = columns[name].mean() + columns[name].std() * rng.standard_normal(rows)
    if channel in ("motor_command", "command_thrust"):
        changed |= {n: np.clip(changed[n], 0.0, 1.0) for n in CHANNEL_COLUMNS[channel]}
    kept, found = refusals(changed)
    assert kept is None
    assert all(any(c.isdigit() for c in issue.issue) for issue in found)  # with the numbers


def test_noise_in_every_column_is_garbage(sample_columns):
    columns, rng = sample_columns["flight_b"], np.random.default_rng(2)
    noise = {
        n: v if n == "t" else np.nanmean(v) + np.nanstd(v) * rng.standard_normal(len(v))
        for n, v in columns.items()
    }
    for names, low, high in ((CHANNEL_COLUMNS["motor_command"], 0, 1), (("cmd_thrust",), 0, 1)):
        noise |= {n: np.clip(noise[n], low, high) for n in names}
    length = np.sqrt(sum(noise[f"q{p}"] ** 2 for p in "wxyz"))
    noise |= {f"q{p}": noise[f"q{p}"] / length for p in "wxyz"}
    kept, found = refusals(noise)
    assert kept is None and {i.kind for i in found} == {"garbage"}


def test_a_column_copied_over_another_is_garbage(sample_columns):
    columns = sample_columns["flight_b"]
    kept, found = refusals(columns | {"ay": columns["ax"]})
    assert kept is None and "hold the same values" in found[0].issue


def test_clocks_apart_filters_and_noise_are_no_contradiction(sample_columns):
    """What honest sensors do: 100 ms between the streams, smoothing, and noise as strong as in bad logs."""
    columns, rng = sample_columns["flight_c"], np.random.default_rng(3)
    late = dict(columns)
    for channel, noise in (("body_rates", 0.3), ("specific_force", 1.0)):
        for name in CHANNEL_COLUMNS[channel]:
            smooth = np.convolve(columns[name], np.full(5, 0.2), "same")
            late[name] = np.roll(smooth, 10) + noise * rng.standard_normal(len(smooth))
    for name in CHANNEL_COLUMNS["position"]:
        late[name] = columns[name] + 0.003 * rng.standard_normal(len(columns[name]))
    kept, found = refusals(late)
    assert found == [] and kept is not None
