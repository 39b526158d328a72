"""Flight logs: containers, formats, importers and checks. Knows no effect."""

import importlib

from openjax.flights.flight import Case, Flight, Issue

_ELSEWHERE = {"load_case": "case"}

__all__ = ["Case", "Flight", "Issue", *_ELSEWHERE]


def __getattr__(name: str):
    # Reading pulls in the vehicle (and JAX); the containers alone stay light to import.
    if name in _ELSEWHERE:
        return getattr(importlib.import_module(f"openjax.flights.{_ELSEWHERE[name]}"), name)
    raise AttributeError(name)
