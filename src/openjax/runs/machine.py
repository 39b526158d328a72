"""The machine that a result was measured on: devices, versions, commit."""

import os
import platform
import subprocess
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from openjax.version import __version__

_PACKAGES = ("jax", "jaxlib", "flax", "optax", "mujoco", "mujoco-mjx", "numpy")


def describe_machine() -> dict:
    """Device, processor, versions, commit and time, as plain values for a results file."""
    import jax

    devices = jax.devices()
    return {
        # of a CPU, JAX's kind is "cpu", which tells no two apart
        "device": devices[0].device_kind if devices[0].platform != "cpu" else _processor(),
        "platform": devices[0].platform,
        "device_count": len(devices),
        "processes": jax.process_count(),
        "cpu_cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "python": platform.python_version(),
        "versions": {"openjax": __version__} | {name: version(name) for name in _PACKAGES},
        **commit(),
        "date": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
    }


def commit() -> dict:
    """`commit` (hash or None) of the running source tree; `commit_clean` is False with
    local changes.
    """
    this_file = Path(__file__).resolve()
    source = this_file.parents[1]
    revision = _git(source, "rev-parse", "HEAD")
    # installed from a wheel, the files may lie inside another repository, whose commit says nothing
    if revision is None or _git(source, "ls-files", "--error-unmatch", str(this_file)) is None:
        return {"commit": None, "commit_clean": None}
    changes = _git(source, "status", "--porcelain", "--", str(source))
    return {"commit": revision, "commit_clean": changes == ""}


def _git(directory, *arguments):
    try:
        answer = subprocess.run(
            ["git", "-C", str(directory), *arguments],
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return answer.stdout.strip()


def _processor():
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
