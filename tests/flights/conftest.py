"""What several tests of logs start from."""

import pytest

from openjax.flights.csv_table import write_csv
from openjax.flights.samples import log_of


@pytest.fixture(scope="package")
def text(sample_columns, tmp_path_factory):
    """A sample flight of four seconds as a CSV's text."""
    path = tmp_path_factory.mktemp("log") / "flight.csv"
    columns = {name: values[:400] for name, values in sample_columns["flight_b"].items()}
    write_csv(path, log_of([columns], "flight"))
    return path.read_text()
