"""Importers: logs of other formats become the same table as a CSV of the log format."""

from __future__ import annotations

from pathlib import Path

from openjax.gap.reading import LogTable, read_csv


def find_logs(folder: Path) -> list[Path]:
    """The logs of a case folder, by name."""
    return sorted(p for p in folder.iterdir() if p.name.endswith((".csv", ".csv.gz")))


def read_log(path: Path) -> LogTable:
    return read_csv(path)
