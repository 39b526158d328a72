"""Sample flights, flown once for the whole folder."""

import pytest

from openjax.gap.reading import write_csv
from openjax.gap.samples import fly, log_of, references
from openjax.vehicle import load_vehicle

VEHICLE_TOML = """
[vehicle]
name = "crazyflie-2.1"
mass = 0.0321
mass_weighed = true

[motor]
command = "thrust"
"""


@pytest.fixture(scope="session")
def sample_columns():
    """Columns of three sample flights of the nominal vehicle: {"flight_a": {"t": ..., ...}, ...}."""
    vehicle = load_vehicle()
    return {
        name: fly(vehicle, vehicle, reference, seed)[0]
        for seed, (name, reference) in enumerate(references(seed=1, duration=8.0).items())
    }


@pytest.fixture
def case_folder(tmp_path, sample_columns):
    """A case folder with the three sample flights."""
    folder = tmp_path / "case"
    folder.mkdir()
    (folder / "vehicle.toml").write_text(VEHICLE_TOML)
    for name, columns in sample_columns.items():
        write_csv(folder / f"{name}.csv.gz", log_of([columns], name))
    return folder
