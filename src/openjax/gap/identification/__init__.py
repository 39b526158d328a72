"""What a vehicle does, before anything is said of why: the response of its torques and
of its thrust, and the numbers of a model of them, from flights in closed loop.
"""

import importlib

_ELSEWHERE = {
    "Identification": "openjax.gap.identification.quantities",
    "identify": "openjax.gap.identification.quantities",
}

__all__ = list(_ELSEWHERE)


def __getattr__(name: str):  # identifying pulls in the vehicle (and JAX)
    if name in _ELSEWHERE:
        return getattr(importlib.import_module(_ELSEWHERE[name]), name)
    raise AttributeError(name)
