"""Reading logs: what is in the file arrives in the right channel, row and vehicle, and
only that.
"""

import gzip
import time
from collections import Counter

import numpy as np
import pytest

from openjax.flights import csv_table, csv_text
from openjax.flights.csv_table import read_csv, write_csv
from openjax.flights.importers import read_log
from openjax.flights.importers.columns import ColumnMapping, Source
from openjax.flights.reading import LogError, LogTable, flights_of

HEADER = "t,wx,wy,wz,ax,ay,az,m1,m2,m3,m4,vbat\n"


def write(path, text):
    path.write_text(text)
    return path


def test_round_trip_of_every_channel(tmp_path, sample_columns):
    columns = sample_columns["flight_b"]
    for name in ("log.csv", "log.csv.gz"):
        write_csv(
            tmp_path / name, LogTable(name, columns, np.full(len(columns["t"]), "0")), {"t": 9}
        )
        table = read_csv(tmp_path / name)
        assert set(table.columns) == set(columns) and not table.remarks
        for column, values in columns.items():
            np.testing.assert_allclose(
                table.columns[column], values, atol=1e-6
            )  # NaN where not sampled
    (a,), (b,) = (flights_of(read_csv(tmp_path / n))[0] for n in ("log.csv", "log.csv.gz"))
    assert a.fingerprint == b.fingerprint
    assert a.quaternion.shape == (len(a), 4) and a.motor_command.shape == (len(a), 4)


def test_empty_cells_are_not_sampled_and_written_nan_is_remarked(tmp_path):
    rows = [
        "0.0,1,2,3,4,5,6,.1,.2,.3,.4,3.7",
        "0.01,,,,4,5,6,.1,.2,.3,.4,",
        "0.02,1,nan,3,4,5,6,.1,.2,.3,.4,",
    ]
    table = read_csv(write(tmp_path / "log.csv", HEADER + "\r\n".join(rows)))
    assert np.isnan(table.columns["wx"]).tolist() == [False, True, False]
    assert np.isnan(table.columns["vbat"]).tolist() == [False, True, True]
    assert table.remarks == ("column wy: 1 of 3 rows are NaN or infinite",)


def test_vehicles_in_long_format_are_told_apart(tmp_path):
    rows = ["t,vehicle,x,y,z,vbat", "0,cf2,2,0,1,4.0", "0,cf1,1,0,1,4.0", ".01,cf2,2.5,0,1,4.0"]
    text = "\n".join(rows)
    first, second = flights_of(read_csv(write(tmp_path / "log.csv", text)))[0]
    assert (first.vehicle, second.vehicle) == ("cf2", "cf1")
    assert first.position[:, 0].tolist() == [2.0, 2.5] and second.position[:, 0].tolist() == [1.0]
    assert first.log == second.log == "log.csv" and first.name != second.name


def test_motors_arrive_in_the_nominal_order(tmp_path):
    text = HEADER + "0,1,2,3,4,5,6,.1,.2,.3,.4,\n"
    table = read_csv(write(tmp_path / "log.csv", text))
    # m1 rear left, m2 front left, m3 front right, m4 rear right: nominal m1 (front
    # right) is the logged m3.
    (flight,), _ = flights_of(table, motor_permutation=(2, 3, 0, 1))
    assert flight.motor_command[0].tolist() == [0.3, 0.4, 0.1, 0.2]


def test_a_channel_with_a_missing_column_is_left_out_and_named(tmp_path):
    table = read_csv(write(tmp_path / "log.csv", "t,x,y,wx,wy,wz,colour\n0,1,2,3,4,5,6\n"))
    (flight,), remarks = flights_of(table)
    assert flight.position is None and flight.body_rates is not None
    assert remarks == [
        "unknown column left out: colour",
        "x, y without z: position is left out; log z",
    ]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "no column names"),
        ("t,wx\n", "no rows"),
        ("0,1\n0.01,2\n", "no column names"),
        ("t wx wy\n0 1 2\n", "separated by spaces"),
        ("t,wx\n0,1\n\nt,wx\n0,1\n", "line 4 is the header again: several recordings"),
        ("t,wx,wx\n0,1,2\n", "'wx' occurs more than once"),
        ("t,wx\n0,1\n0.01,fast\n", "line 3, column wx: 'fast' is no number"),
        ("t,wx\n0,1\n0.01\n0.02,1\n", "line 3 has 1 cells, the header 2"),
        ("t,wx\n0,1\n0.01,2,3\n", "line 3 has 3 cells, the header 2"),
        ("colour,shape\n0,1\n", "no column t; the log has colour, shape"),
        ("wx,wy\n0,1\n", "no column t"),
    ],
)
def test_what_is_no_log_says_why(tmp_path, text, reason):
    with pytest.raises(LogError, match=reason):
        flights_of(read_csv(write(tmp_path / "log.csv", text)))


@pytest.mark.parametrize(
    "data",
    [b"\x1f\x8bnot gzip", gzip.compress(b"t,wx\n0,1\n" * 500)[:40], b"\xff\xfe\x00t"],
    # gzip writes the time into its header: names from the data would differ between the
    # processes of a run
    ids=["no gzip", "cut short", "no text"],
)
def test_corrupt_files_say_so(tmp_path, data):
    path = tmp_path / "log.csv.gz"
    path.write_bytes(data if data[:1] == b"\x1f" else gzip.compress(data))
    with pytest.raises(LogError):
        read_csv(path)


@pytest.mark.parametrize("end", ["\r", "\r\n"])
def test_other_line_ends_and_a_last_line_cut_off(tmp_path, end):
    text = end.join(["t,wx,wy,wz", *(f"{k / 100:.2f},1,2,3" for k in range(50_000)), "500.00,1"])
    table = read_csv(write(tmp_path / "log.csv", text))
    assert len(table.columns["t"]) == 50_000 and table.columns["wz"][-1] == 3.0
    assert table.remarks == ("the last line is cut off and left out",)


def test_a_file_that_unpacks_to_gigabytes_is_refused_before_it_does(tmp_path, monkeypatch):
    monkeypatch.setattr(csv_text, "LARGEST", 1 << 20)
    path = tmp_path / "log.csv.gz"
    path.write_bytes(gzip.compress(b"t,wx\n" + b"0," * (1 << 21)))
    with pytest.raises(LogError, match="more than 1 MB"):
        read_csv(path)


def test_absurd_values_are_not_sampled(tmp_path):
    text = "t,wx,wy,wz\n" + "0.00,1,2,3\n" * 3 + "0.01,1e300,2,3\n0.02,-inf,2,3\n"
    (flight,), remarks = flights_of(read_csv(write(tmp_path / "log.csv", text)))
    assert np.isfinite(flight.body_rates).sum() == 13 and len(remarks) == 2


def test_many_columns_and_rows_take_as_many_times_the_work(tmp_path, monkeypatch):
    """What reading a log costs grows with its cells: names and numbers are looked at
    once each.
    """
    calls = Counter()
    number = csv_table._number
    monkeypatch.setattr(csv_table, "_number", lambda cell: calls.update([1]) or number(cell))
    rows = 2_000
    columns = {c: np.ones(rows) for c in HEADER.strip().split(",")}
    write_csv(tmp_path / "log.csv", LogTable("log.csv", columns, np.full(rows, "0")))
    read_csv(tmp_path / "log.csv")
    # of the first row, whether it holds units, too
    assert calls[1] == (rows + 1) * len(columns)


@pytest.mark.parametrize("names", [20_000, 100_000])
def test_a_log_that_lost_its_line_ends_is_refused_at_its_first_row(tmp_path, names):
    """Half a megabyte of columns: as many names are compared with each other in no
    time.
    """
    text = ",".join(f"c{k}" for k in range(names)) + "\n" + ",".join("1" for _ in range(names))
    start = time.process_time()
    with pytest.raises(LogError, match=f"has {names} cells, more than 2000 columns") as caught:
        read_csv(write(tmp_path / "log.csv", text))
    assert time.process_time() - start < 5.0 and len(str(caught.value)) < 200


def test_a_wide_log_names_a_few_of_its_columns(tmp_path):
    text = ",".join(f"c{k}" for k in range(1_500)) + "\n"
    with pytest.raises(LogError, match=r"c11 and 1488 more: say in columns\.toml") as caught:
        read_csv(write(tmp_path / "log.csv", text))
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("line", [b"\n", b" \n", b",\n", b"\r"])
def test_lines_without_end_are_refused_while_they_are_unpacked(tmp_path, monkeypatch, line):
    """A small file that unpacks to millions of lines never becomes a list of them."""
    monkeypatch.setattr(csv_text, "MOST_ROWS", 10_000)
    unpacked = []
    opened = gzip.open

    class Watched(gzip.GzipFile):
        def read(self, size=-1):
            unpacked.append(size)
            return super().read(size)

    monkeypatch.setattr(csv_text.gzip, "open", Watched)
    path = tmp_path / "log.csv.gz"
    with opened(path, "wb") as file:
        file.write(b"t,wx\n" + line * (20 * csv_text.CHUNK))
    with pytest.raises(LogError, match="more than 10000 lines"):
        read_csv(path)
    assert unpacked == [csv_text.CHUNK]


def test_as_many_vehicles_as_rows_are_no_swarm(tmp_path):
    rows = "\n".join(f"{k / 100},{k},1,2,3" for k in range(500))
    with pytest.raises(LogError, match="column vehicle holds 500 ids, 0, 1, 2 and 497 more"):
        flights_of(read_csv(write(tmp_path / "log.csv", "t,vehicle,wx,wy,wz\n" + rows)))


TEXTS = ["0", "ANGLE", "ANGLE|HORIZON", "", "0x1f", "é", "1e", "nan", '"arm, fly"']


@pytest.mark.parametrize("first", TEXTS[:3])
@pytest.mark.parametrize("name", ["flightModeFlags (flags)", "x", "qw"])
def test_columns_that_nobody_asks_for_may_hold_text(tmp_path, first, name):
    """With a columns.toml too: unmapped ones, and those in whose place another is
    named.
    """
    sources = {"t": "time", "wx": "gyro", "x": "px", "roll": "r", "pitch": "p", "yaw": "y"}
    mapping = ColumnMapping({column: Source(raw) for column, raw in sources.items()})
    rows = [f"{k / 100},1,2,3,4,5,{text}" for k, text in enumerate([first, *TEXTS])]
    text = "\n".join([f'time,gyro,px,r,p,y,"{name}"', *rows])
    table = read_log(write(tmp_path / "log.csv", text), mapping)
    assert table.columns["wx"].tolist() == [1.0] * len(rows) and table.columns["x"][0] == 2.0
    assert table.remarks == (f"unknown column left out: {name}",)


def test_a_mapped_column_that_holds_text_says_where(tmp_path):
    mapping = ColumnMapping({"wx": Source("mode")})
    with pytest.raises(LogError, match="line 3, column mode: 'ANGLE' is no number"):
        read_log(write(tmp_path / "log.csv", "t,mode\n0,0\n.01,ANGLE\n"), mapping)
