"""Flight logs and what separates them from the simulator: reading, checking, calibrating, diagnosing."""

import importlib

from openjax.gap.flight import Case, Flight, Issue

_ELSEWHERE = {"load_case": "case", "diagnose": "diagnosis", "diagnose_case": "diagnosis", "Report": "report"}

__all__ = ["Case", "Flight", "Issue", *_ELSEWHERE]


def __getattr__(name: str):
    # Reading pulls in the vehicle (and JAX); the containers alone stay light to import.
    if name in _ELSEWHERE:
        return getattr(importlib.import_module(f"openjax.gap.{_ELSEWHERE[name]}"), name)
    raise AttributeError(name)
