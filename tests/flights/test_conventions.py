"""Rows in another program's convention are refused by a line that names it; conventions
are turned here by rotation matrices, independently of the module.
"""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from openjax.flights.case import load_case
from openjax.flights.checks import check_flight
from openjax.flights.conventions import CONVENTIONS
from openjax.flights.flight import CHANNEL_COLUMNS
from openjax.flights.pairs import Signals
from openjax.flights.reading import LogTable, flights_of
from openjax.vehicle import load_vehicle

WORLD = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])  # ENU to NED
BODY = np.diag([1.0, -1.0, -1.0])  # FLU to FRD


def flight_of(columns):
    (flight,), _ = flights_of(LogTable("flight.csv", columns, np.full(len(columns["t"]), "0")))
    return flight


def into(columns, world, body):
    """Columns in another world's and body's axes."""
    out = dict(columns)
    for channel, turn in (
        ("position", world),
        ("velocity", world),
        ("body_rates", body),
        ("specific_force", body),
        ("command_body_rates", body),
    ):
        names = CHANNEL_COLUMNS[channel]
        if names[0] in columns:
            out |= dict(zip(names, turn @ np.stack([columns[n] for n in names]), strict=True))
    quaternion = np.stack([columns[f"q{a}"] for a in "wxyz"], 1)
    matrix = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
    turned = Rotation.from_matrix(world @ matrix @ body.T).as_quat(scalar_first=True)
    return out | {f"q{a}": turned[:, i] for i, a in enumerate("wxyz")}


def with_legacy_pitch(columns, gyroscope=False):
    quaternion = np.stack([columns[f"q{a}"] for a in "wxyz"], 1)
    yaw, pitch, roll = Rotation.from_quat(quaternion, scalar_first=True).as_euler("ZYX").T
    turned = Rotation.from_euler("ZYX", np.stack([yaw, -pitch, roll], 1))
    values = turned.as_quat(scalar_first=True)
    out = columns | {f"q{a}": values[:, i] for i, a in enumerate("wxyz")}
    return out | ({"wy": -columns["wy"]} if gyroscope else {})


def without(columns, *channels):
    names = {n for c in channels for n in CHANNEL_COLUMNS[c]}
    return {n: v for n, v in columns.items() if n not in names}


CASES = {
    "legacy pitch": (with_legacy_pitch, r"^pitch has the other sign.*scale = -1"),
    "legacy pitch and gyroscope": (
        lambda c: with_legacy_pitch(c, True),
        r"^pitch and wy have the other sign.*scale = -1",
    ),
    "NED": (lambda c: into(c, WORLD, BODY), r"NED, FRD.*Rows in NED"),
    "NED without accelerometer": (
        lambda c: into(without(c, "specific_force"), WORLD, BODY),
        r"NED, FRD",
    ),
    "FRD without a pose": (
        lambda c: without(into(c, WORLD, BODY), "position", "velocity", "quaternion"),
        r"body's axes are forward, right, down",
    ),
    "FRD": (lambda c: into(c, np.eye(3), BODY), r"body's axes are forward, right, down"),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("flight", ["flight_a", "flight_b"])
def test_another_convention_is_named(name, flight, sample_columns):
    convert, words = CASES[name]
    kept, issues = check_flight(flight_of(convert(sample_columns[flight])), load_vehicle())
    refused = [issue.issue for issue in issues if issue.refused]
    assert kept is None
    assert len(refused) == 1, refused
    assert re.search(words, refused[0]), refused


def test_conventions_leave_what_was_not_logged():
    nothing = Signals(**{f.name: None for f in dataclasses.fields(Signals)})
    for convention in CONVENTIONS:
        assert set(vars(convention.convert(nothing)).values()) == {None}


def test_the_pages_recipe_turns_rows_in_ned(tmp_path, sample_columns):
    """The lines under Rows in NED, on a log in NED with angles."""
    page = (Path(__file__).parents[2] / "docs" / "log_format.md").read_text(encoding="utf-8")
    recipe = page.split("### Rows in NED")[1].split("```toml")[1].split("```")[0]
    (tmp_path / "columns.toml").write_text(recipe)
    (tmp_path / "vehicle.toml").write_text("")
    columns = {n: v[:400] for n, v in sample_columns["flight_b"].items() if n != "vbat"}
    other = into(columns, WORLD, BODY)
    quaternion = np.stack([other[f"q{a}"] for a in "wxyz"], 1)
    angles = Rotation.from_quat(quaternion, scalar_first=True).as_euler("ZYX").T
    names = dict(zip("xyz", ("ned_x", "ned_y", "ned_z"), strict=True))
    names |= {f"v{a}": f"ned_v{a}" for a in "xyz"} | {f"a{a}": f"frd_a{a}" for a in "xyz"}
    names |= {"wx": "frd_p", "wy": "frd_q", "wz": "frd_r"}
    table = {"t": other["t"]} | {new: other[old] for old, new in names.items()}
    table |= dict(zip(("frd_yaw", "frd_pitch", "frd_roll"), angles, strict=True))
    table |= {f"m{i}": other[f"m{i}"] for i in (1, 2, 3, 4)}
    lines = [
        ",".join(table),
        *(",".join(f"{v:.9g}" for v in row) for row in zip(*table.values(), strict=True)),
    ]
    (tmp_path / "flight.csv").write_text("\n".join(lines))
    (flight,) = load_case(tmp_path).flights
    own = flight_of(columns)
    np.testing.assert_allclose(flight.position, own.position, atol=1e-6)
    np.testing.assert_allclose(flight.specific_force, own.specific_force, atol=1e-6)
    np.testing.assert_allclose(np.abs((flight.quaternion * own.quaternion).sum(1)), 1.0, atol=1e-6)
