"""What a diagnosis weighed, kept beside its report, so that a miss can be studied without doing the case again.

`experiments.diagnosis.diagnose --study` writes `study.json` into each folder: what each effect named or not named adds on
stretches left out, what comes near in a name's place, the unexplained rest, the radio, the rate loop, the pose and the
sensors as they were read, and `states`: mean squared errors by channel and second of flight, with all effects, without each, and
without any. For development: it reads what the engine holds, and isn't part of the exam's judgement.
"""

import json
from pathlib import Path

import numpy as np


def plain(value, digits=4):
    """JSON-ready: arrays as lists, numbers with so many digits, keys as text."""
    if isinstance(value, dict):
        return {k if isinstance(k, str) else "+".join(map(str, k)): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if value is None or isinstance(value, str | bool | int):
        return value
    return float(f"{float(value):.{digits}g}")


def gains(table):
    return {e: {k: getattr(g, k) for k in ("nats", "steady", "floors", "share")} for e, g in table.items()}


def notes(report):
    """{topic: plain data} of the evidence behind a report; a topic that can't be read says why."""
    evidence, selection = report.plots["evidence"], report.plots["selection"]
    physics = list(selection.fit.effects)

    def states():
        from openjax.gap.shares import _squares

        named = tuple(e for e in report.effects if e != "unknown")
        sets = {"all": named, "before": (), "raw": (), "plain": named}
        sets |= {e: tuple(n for n in named if n != e) for e in named}
        out = {}
        for name, kept in sets.items():
            own = [e for e in physics if e in kept]
            out[name] = _squares(evidence, selection, own, kept, sensors=name not in ("raw", "plain"))
        return out

    def rest():
        from openjax.gap.rest import look

        found = look(evidence, selection)
        return {
            "everything": found.everything._asdict(),
            "others": found.others._asdict(),
            "strange": found.strange._asdict(),
            "plain": found.plain._asdict(),
            "followed": found.followed,
            "lines": found.local,
        }

    def radio():
        r = evidence.radio
        keys = ("delay", "loss", "gain", "misfit", "informative", "readable")
        return None if r is None else {k: getattr(r, k, None) for k in keys}

    def path(name):
        found = getattr(evidence, name)
        if found is None:
            return None
        score, theta, covariance = found.score()
        return {"nats": score, "value": theta, "deviation": np.sqrt(np.diag(covariance))}

    def sensors():
        s = evidence.sensors
        return {
            k: getattr(s, k, None) for k in ("gain", "gain_error", "coherence", "tilt", "wander", "one_clock")
        }

    def rate_gains():
        g = evidence.gains
        return None if g is None else {k: getattr(g, k, None) for k in ("change", "error", "clear")}

    def singles():
        base = evidence.nothing.score
        return {k[0]: f.score - base for k, f in evidence.sets.items() if len(k) == 1}

    def spread():
        return {e: {p: v for p, v in found.items()} for e, found in selection.fit.parameters().items()}

    topics = {
        "gains": lambda: gains(selection.gains),
        "offered": lambda: gains(selection.offered),
        "swaps": lambda: selection.swaps,
        "exposure": lambda: evidence.exposure,
        "singles": singles,
        "fitted": spread,
        "rest": rest,
        "radio": radio,
        "rate_loop": lambda: path("rate_loop"),
        "pose": lambda: path("pose"),
        "rate_gains": rate_gains,
        "sensors": sensors,
        "seconds": lambda: evidence.seconds,
        "states": states,
    }
    out = {}
    for name, read in topics.items():
        try:
            out[name] = plain(read())
        except Exception as error:  # the engine changes; what is left can still be studied
            out[name] = f"not read: {type(error).__name__}: {error}"
    return out


def with_notes(write_report):
    """`write_report` that also writes `study.json`."""

    def write(report, folder, *arguments, **options):
        write_report(report, folder, *arguments, **options)
        (Path(folder) / "study.json").write_text(json.dumps(notes(report)))

    return write
