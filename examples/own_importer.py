"""Logs in a format of one's own: two functions say which files are such logs and what they hold.

python examples/own_importer.py flights/ours
"""

import json
import sys
from pathlib import Path

import numpy as np

from openjax.flights.case import load_case
from openjax.flights.importers import Importer, register
from openjax.flights.reading import LogError, LogTable
from openjax.gap.diagnosis import diagnose_case

COLUMNS = {"p": "x y z", "q": "qw qx qy qz", "gyro": "wx wy wz", "u": "m1 m2 m3 m4"}


def is_ours(path):
    return path.name.endswith(".flight.jsonl")


def read(path, mapping):
    """One JSON object a line: {"ms": 10, "p": [x, y, z], "q": [...], "gyro": [...], "u": [...]}."""
    rows = [json.loads(line) for line in path.read_text().splitlines()]
    if not rows:
        raise LogError("holds no row")
    columns = {"t": np.array([row["ms"] for row in rows]) * 1e-3}
    for key, names in COLUMNS.items():
        values = np.array([row[key] for row in rows], float)
        columns |= dict(zip(names.split(), values.T, strict=True))
    return LogTable(path.name, columns, vehicle=np.full(len(rows), "0"))


register(Importer("our robots' JSON", is_ours, read))

if __name__ == "__main__":
    case = load_case(Path(sys.argv[1]))
    print("\n".join(diagnose_case(case).in_words()))
