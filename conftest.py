"""Settings and fixtures of the whole suite: it compiles much and computes little, so
the compiler may leave out costly passes.
"""

import gc
import importlib
import os
import sys
from importlib.metadata import version
from pathlib import Path
from types import SimpleNamespace

import pytest
from beartype import BeartypeConf, beartype
from hypothesis import HealthCheck, settings
from jaxtyping import install_import_hook

# many processes load the same modules: bytecode is kept, also where the environment
# says otherwise
sys.dont_write_bytecode = False
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)

_beartype = beartype(conf=BeartypeConf(is_pep484_tower=True))  # an int is a float, too


def check_types(function):
    """A function that raises where an argument or a result isn't of its type.

    Structures are left alone: JAX puts into their fields whatever a transformation
    needs, axes or nothing at all. Settings check themselves, and a private function is
    its module's business.
    """
    if function.__name__.startswith("_"):
        return function
    checked = _beartype(function)

    def checked_unless_stand_in(*args, **kwargs):
        given = (*args, *kwargs.values())
        given += tuple(item for value in given if isinstance(value, list | tuple) for item in value)
        # a test that makes a namespace of the few things a function looks at knows what
        # it does
        if not any(isinstance(value, SimpleNamespace) for value in given):
            checked(*args, **kwargs)

    return checked_unless_stand_in


# shapes and types of arrays in signatures are checked at each call, which is when a
# function is traced
_networks = [
    f"openjax.policy.{name}" for name in ("actor_critic", "encoder", "policy", "predictor")
]
_drone = [f"openjax.vehicle.{name}" for name in ("rigid_body", "rate_controller", "stops")]
_rooms = ["openjax.pursuit", "openjax.learning", "openjax.flights", "openjax.gap"]
install_import_hook([*_networks, *_drone, *_rooms], "conftest.check_types")

_flags = "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
# workers are the parallel part: more threads would only wait for each other's cores,
# and a program that is compiled in parts for them takes a fifth longer
_flags += " --xla_cpu_multi_thread_eigen=false --xla_cpu_parallel_codegen_split_count=1"
if version("jaxlib").startswith("0.10."):
    # its way of fusing compiles three times as long; later versions know no such flag
    _flags += " --xla_cpu_use_fusion_emitters=false"
os.environ.setdefault("XLA_FLAGS", _flags)
# adds the flag without which sums are wrong, if JAX needs it
importlib.import_module("openjax")
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# what one test compiled, its other processes, other workers and the next session
# needn't compile again
os.environ.setdefault(
    "JAX_COMPILATION_CACHE_DIR", str(Path(__file__).parent / ".pytest_cache" / "compiled")
)
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "0")

# how long an example takes says how busy the machine is
settings.register_profile("suite", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("suite")

# tracing leaves many objects and little garbage
gc.set_threshold(100_000, 50, 50)


def pytest_collection_modifyitems(items):
    """What needs the machine to itself is no part of `make test`, whoever forgot to say
    so.
    """
    for item in items:
        if item.get_closest_marker("real_time"):
            item.add_marker(pytest.mark.slow)


VEHICLE_TOML = """
[vehicle]
name = "crazyflie-2.1"
mass = 0.0321
mass_weighed = true

[motor]
command = "thrust"
"""


@pytest.fixture(scope="session")
def ruled_reports():
    """From here on every report that this process makes is held against the rules of
    reports.
    """
    from openjax.gap import diagnosis
    from openjax.gap.report.rules import broken_rules

    conclude = diagnosis.conclude

    def ruled(*arguments):
        report = conclude(*arguments)
        assert broken_rules(report) == []
        return report

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(diagnosis, "conclude", ruled)
        yield


@pytest.fixture(scope="session")
def sample_columns():
    """Columns of three sample flights of the nominal vehicle: {"flight_a": {"t": ...,
    ...}, ...}.
    """
    from openjax.flights.manoeuvres import references
    from openjax.flights.samples import fly
    from openjax.vehicle import load_vehicle

    vehicle = load_vehicle()
    return {
        name: fly(vehicle, vehicle, reference, seed)[0]
        for seed, (name, reference) in enumerate(references(seed=1, duration=8.0).items())
    }


@pytest.fixture
def case_folder(tmp_path, sample_columns):
    """A case folder with the three sample flights."""
    from openjax.flights.csv_table import write_csv
    from openjax.flights.samples import log_of

    folder = tmp_path / "case"
    folder.mkdir()
    (folder / "vehicle.toml").write_text(VEHICLE_TOML)
    for name, columns in sample_columns.items():
        write_csv(folder / f"{name}.csv.gz", log_of([columns], name))
    return folder
