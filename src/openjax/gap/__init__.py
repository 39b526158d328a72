"""Flight logs and what separates them from the simulator: reading, checking, calibrating, diagnosing."""

from openjax.gap.flight import Case, Flight, Issue

__all__ = ["Case", "Flight", "Issue", "load_case"]


def __getattr__(name: str):
    # Reading pulls in the vehicle (and JAX); the containers alone stay light to import.
    if name == "load_case":
        from openjax.gap.case import load_case

        return load_case
    raise AttributeError(name)
