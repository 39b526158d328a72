"""Cases: one hostile input each, and what openjax made of it."""

import contextlib
import dataclasses
import io
import math
import random
import resource
import tempfile
import time
import traceback
from pathlib import Path

import numpy as np

from openjax.command_line import LONGEST, one_line
from tests.fuzz.inputs import KINDS

SECONDS = 30.0
MEGABYTES = 1000.0

_warm: set = set()


def finite(tree) -> bool:
    """Whether every number of plain values, dataclasses or arrays is finite."""
    if dataclasses.is_dataclass(tree):
        return all(finite(getattr(tree, field.name)) for field in dataclasses.fields(tree))
    if isinstance(tree, dict):
        return all(map(finite, tree.values()))
    if isinstance(tree, tuple | list):
        return all(map(finite, tree))
    if isinstance(tree, float):
        return math.isfinite(tree)
    if hasattr(tree, "dtype") and np.issubdtype(np.asarray(tree).dtype, np.floating):
        return bool(np.isfinite(np.asarray(tree)).all())
    return True


def try_case(kind: str, seed: int) -> tuple[str, str]:
    """One case: `refused`, `accepted` or `failed`, and what is to be told of it."""
    function = KINDS[kind]
    rng = random.Random(f"{kind} {seed}")
    memory = _megabytes()
    started = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "work"
        place.mkdir()
        try:
            with contextlib.redirect_stderr(io.StringIO()):
                accepted = function(rng, place)
            outcome = "accepted"
            told = ""
            if not finite(accepted):
                outcome = "failed"
                told = "nonsense accepted: a number that isn't finite"
        except Exception as error:
            told = one_line(error)
            outcome = "refused"
            if told is None or "\n" in told or not told or len(told) > LONGEST:
                outcome = "failed"
                told = "".join(traceback.format_exception(error))[-2000:]
        left = [
            str(path)
            for path in place.rglob("*")
            if path.name.startswith(".writing") or path.name == "run"
        ]
        if left:
            outcome = "failed"
            told = f"left behind: {left[:3]}"
    if time.process_time() - started > SECONDS:
        outcome = "failed"
        told = f"took {time.process_time() - started:.0f} s ({told})"
    if _megabytes() - memory > MEGABYTES:
        outcome = "failed"
        told = f"took {_megabytes() - memory:.0f} MB ({told})"
    return outcome, told


def _megabytes():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def try_cases(kind: str, seeds: range) -> list[tuple[str, int, str, str]]:
    """Several cases: kind, seed, outcome, text."""
    # what is loaded for the first of its kind isn't that case's fault
    if kind not in _warm:
        try_case(kind, -1)
        _warm.add(kind)
    return [(kind, seed, *try_case(kind, seed)) for seed in seeds]
