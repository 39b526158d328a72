"""Whatever a log holds, a case is read or refused in one line: never a traceback, and
one bad log never takes the others with it.
"""

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from openjax.errors import UserError
from openjax.flights.case import load_case
from openjax.flights.checks import check_flight
from openjax.flights.csv_table import write_csv
from openjax.flights.reading import LOG_COLUMNS, LogTable, flights_of
from openjax.flights.samples import log_of
from openjax.vehicle import load_vehicle

VEHICLE = load_vehicle()

CELLS = st.sampled_from(
    [
        "",
        "nan",
        "inf",
        "-inf",
        "1e300",
        "1e-300",
        "-0",
        "0",
        "x",
        '"',
        ",",
        "\n",
        "\r",
        "1;2",
        "\t",
        "é",
    ]
)
EDITS = st.lists(st.tuples(st.floats(0, 1), st.integers(0, 40), CELLS), min_size=1, max_size=12)


@settings(
    max_examples=25,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(edits=EDITS)
def test_a_damaged_log_is_read_or_refused(text, tmp_path, edits):
    for place, removed, inserted in edits:
        at = int(place * len(text))
        text = text[:at] + inserted + text[at + removed :]
    (tmp_path / "vehicle.toml").write_text("")
    (tmp_path / "flight.csv").write_text(text, encoding="utf-8")
    for comparison in (False, True):
        try:
            case = load_case(tmp_path, comparison=comparison)
        except UserError as error:
            assert "\n" not in str(error)
        else:
            assert all(np.isfinite(f.time).all() for f in case.flights)


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_a_column_that_holds_one_value_is_a_finding_not_an_error(sample_columns, value):
    short = {n: v[:300] for n, v in sample_columns["flight_b"].items()}
    short |= {f"w{i}": 2500.0 * np.sqrt(short[f"m{i}"]) for i in (1, 2, 3, 4)}
    for column in (c for c in LOG_COLUMNS if c not in ("t", "vehicle")):
        columns = short | {column: np.full(300, value)}
        (flight,), _ = flights_of(LogTable("flight.csv", columns, np.full(300, "0")))
        for comparison in (False, True):
            kept, issues = check_flight(flight, VEHICLE, None, comparison)
            assert kept is not None or any(i.refused for i in issues)


def test_logs_of_unlike_kinds_are_one_case(case_folder, sample_columns):
    """A flight with all channels, one with the pose alone, one with inertial sensors
    alone.
    """
    pose = ("t", "x", "y", "z", "qw", "qx", "qy", "qz", "m1", "m2", "m3", "m4")
    inertial = ("t", "ax", "ay", "az", "wx", "wy", "wz", "cmd_thrust", "cmd_wx", "cmd_wy", "cmd_wz")
    for name, kept in (("flight_b", pose), ("flight_c", inertial)):
        columns = {c: sample_columns[name][c] for c in kept}
        write_csv(case_folder / f"{name}.csv.gz", log_of([columns], name))
    case = load_case(case_folder)
    assert len(case.flights) == 3 and not any(i.refused for i in case.quality)
    assert [f.body_rates_derived for f in case.flights] == [False, True, False]
