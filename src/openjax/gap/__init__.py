"""The gap between flights and the simulator: calibration and diagnosis. `openjax.flights` reads and
checks the logs.
"""

import importlib

_ELSEWHERE = {
    "load_case": "openjax.flights.case",
    "diagnose_case": "openjax.gap.diagnosis",
    "Report": "openjax.gap.report",
}

__all__ = list(_ELSEWHERE)


def __getattr__(name: str):  # diagnosing pulls in the vehicle (and JAX)
    if name in _ELSEWHERE:
        return getattr(importlib.import_module(_ELSEWHERE[name]), name)
    raise AttributeError(name)
