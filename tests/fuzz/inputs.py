"""One function per kind of input: it makes a hostile one in an empty folder and hands
it in.

It returns what was accepted; whatever a user would see in one line is raised.
"""

import contextlib
import gzip
import io
import json
import os
import random
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from tests.fuzz.mutations import VALUES, changed_bytes, changed_text, changed_values


def fuzz_train(rng: random.Random, folder: Path):
    import jax

    from openjax.cluster.processes import Processes
    from openjax.command_line import option_names
    from openjax.learning import make_start
    from openjax.runs.request import membership, read_command
    from openjax.runs.start import prepare
    from openjax.runs.train_command import TrainCommand

    names = _cached("train options", lambda: option_names(TrainCommand()))
    chosen = rng.choices(names, k=rng.randint(1, 3))
    # a folder of our own unless the option is about one
    arguments = [] if {"--out", "--resume"} & set(chosen) else ["--out", str(folder / "run")]
    arguments += _hostile_options(rng, chosen, names)
    with _in(folder), contextlib.redirect_stdout(io.StringIO()):
        if membership(arguments) is not None:
            return None  # of several processes; whether they meet is not asked here
        job, _, _ = prepare(read_command(arguments), arguments, 0.0, Processes())
        start = make_start(job.settings, job.parts)
        jax.eval_shape(start, jax.random.key(0))  # what was accepted can be built
    return job.settings


def fuzz_evaluate(rng: random.Random, folder: Path):
    from openjax.command_line import option_names, parse
    from openjax.commands.evaluate import PROGRAM, EvaluateCommand, prepare

    names = _cached("evaluate options", lambda: option_names(EvaluateCommand()))
    arguments = _hostile_options(rng, rng.choices(names, k=rng.randint(1, 3)), names)
    with _in(folder), contextlib.redirect_stdout(io.StringIO()):
        command = parse(EvaluateCommand, EvaluateCommand(), arguments, PROGRAM)
        return [own.environment for own, *_ in prepare(command, arguments)]


def fuzz_benchmark(rng: random.Random, folder: Path):
    from openjax.command_line import option_names, parse
    from openjax.commands.benchmark import PROGRAM, BenchmarkCommand

    names = _cached("benchmark options", lambda: option_names(BenchmarkCommand()))
    arguments = _hostile_options(rng, rng.choices(names, k=rng.randint(1, 3)), names)
    with _in(folder), contextlib.redirect_stdout(io.StringIO()):
        return parse(BenchmarkCommand, BenchmarkCommand(), arguments, PROGRAM).settings


def fuzz_settings(rng: random.Random, folder: Path):
    from openjax.files import to_plain
    from openjax.learning import preset
    from openjax.store.run_directory import RunDirectory

    stored = {
        "format": "openjax run 1",
        "settings": to_plain(preset(rng.choice(("quick", "paper")))),
        "command": "x",
    }
    if rng.random() < 0.5:
        text = json.dumps(changed_values(rng, stored))
    else:
        text = changed_text(rng, json.dumps(stored, indent=1))
    (folder / "settings.json").write_text(text, encoding="utf-8", errors="replace")
    return RunDirectory(folder).read_settings()


LAYOUT = """name = "own"
pillars = [[0.0, 0.0], [0.3, -0.3]]
pursuers = [[0.5, 0, 0.6], [0.5, 0.3, 0.6], [0.6, -0.3, 0.6]]
evader = [-0.5, 0.1, 0.7]
"""

EFFECTS = """notes = "text"
[rotor_drag]
d_xy = { value = 0.012, unit = "N s/m", interval90 = [0.0113, 0.0128] }
d_z = 0.0
[wind]
x = 0.3
"""

VEHICLE = """[vehicle]
name = "cf"
mass = 0.032  # kg
mass_weighed = true
[vehicles.2]
mass = 0.033
[motor]
command = "thrust"
order = ["front_right", "rear_right", "rear_left", "front_left"]
spin = ["ccw", "cw", "ccw", "cw"]
torque_per_thrust = 0.006
[log]
floor_z = 0.0
motion_capture_rate = 100
[calibrated.thrust_constant]
value = 3.1e-10
interval90 = [3.0e-10, 3.2e-10]
unit = "N s^2"
[calibrated.inertia]
value = [1.6e-5, 1.6e-5, 2.9e-5]
interval90 = [[1.5e-5, 1.7e-5], [1.5e-5, 1.7e-5], [2.8e-5, 3.0e-5]]
"""


def fuzz_layout(rng: random.Random, folder: Path):
    from openjax.pursuit import PursuitSettings, find_scenario, scenario_task

    path = _write(folder / "own.toml", changed_text(rng, LAYOUT))
    scenario = find_scenario(str(path), PursuitSettings())
    slots = len(scenario.pillars)
    number = len(scenario.pursuers)
    return scenario_task(
        PursuitSettings(min_pillars=0, max_pillars=slots, num_pursuers=number), scenario
    )


def fuzz_effects(rng: random.Random, folder: Path):
    from openjax.vehicle.effects import load_effects

    return load_effects(_write(folder / "effects.toml", changed_text(rng, EFFECTS)))


def fuzz_vehicle(rng: random.Random, folder: Path):
    import jax

    from openjax.vehicle.vehicle_file import load_vehicle_file

    file = load_vehicle_file(_write(folder / "vehicle.toml", changed_text(rng, VEHICLE)))
    leaves = {key: np.asarray(leaf) for key, leaf in vars(file.vehicle).items()}
    for name in ("mass", "thrust_constant", "torque_constant", "motor_time_constant", "inertia"):
        if not (leaves[name] > 0).all():
            raise AssertionError(f"{name} is {leaves[name]}")
    return jax.tree.leaves(file.vehicle)


def fuzz_log(rng: random.Random, folder: Path):
    from openjax.flights.case import load_case

    case = _cached("case", _sample_case)
    name = rng.choice(sorted(name for name in case if name.endswith(".csv.gz")))
    for kept in ("vehicle.toml", name):
        (folder / kept).write_bytes(case[kept])
    kind = rng.random()
    if kind < 0.2:
        (folder / name).write_bytes(changed_bytes(rng, case[name]))
    elif kind < 0.3:
        (folder / name).write_bytes(gzip.compress(b"\0" * 10**8))  # much in little
    else:
        (folder / name).unlink()
        text = changed_text(rng, gzip.decompress(case[name]).decode())
        _write(folder / name.removesuffix(".gz"), text)
    found = load_case(folder)
    return [flight.channels for flight in found.flights if hasattr(flight, "channels")]


def fuzz_policy(rng: random.Random, folder: Path):
    from openjax.store.policies import load_policy
    from openjax.store.policy_files import WEIGHTS

    good = _cached("policy", (WEIGHTS / "open.npz").read_bytes)
    path = folder / "policy.npz"
    kind = rng.random()
    if kind < 0.5:
        path.write_bytes(changed_bytes(rng, good))
    else:
        path.write_bytes(_other_policy(rng, good, kind))
    loaded = load_policy(path)
    return vars(loaded.parameters), loaded.settings


def _other_policy(rng, good, kind):
    """The archive written anew with a member changed: its header, its numbers, its
    settings.
    """
    with zipfile.ZipFile(io.BytesIO(good)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    if kind < 0.7:
        header = json.loads(np.load(io.BytesIO(members["openjax.json.npy"])).tobytes())
        part = rng.choice(("settings", "dtypes", None))
        header = (
            changed_values(rng, header)
            if part is None
            else {**header, part: changed_values(rng, header[part])}
        )
        text = json.dumps(header) if rng.random() < 0.8 else changed_text(rng, json.dumps(header))
        stream = io.BytesIO()
        np.save(stream, np.frombuffer(text.encode("utf-8", "replace"), np.uint8))
        members["openjax.json.npy"] = stream.getvalue()
    else:
        name = rng.choice(list(members))
        if kind < 0.8:
            members[name] = changed_bytes(rng, members[name])
        elif kind < 0.9:  # a header that promises much
            text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({rng.choice((10**9, 10**30, -5))},), }}"
            members[name] = (
                b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode() + b"\0" * 64
            )
        else:
            array = np.load(io.BytesIO(members[name]), allow_pickle=False)
            stream = io.BytesIO()
            np.save(stream, np.full(array.shape, rng.choice((np.nan, np.inf)), np.float16))
            members[name] = stream.getvalue()
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return stream.getvalue()


KINDS: dict[str, Callable] = {
    "training command lines": fuzz_train,
    "evaluation command lines": fuzz_evaluate,
    "benchmark command lines": fuzz_benchmark,
    "settings files": fuzz_settings,
    "layouts": fuzz_layout,
    "effects files": fuzz_effects,
    "vehicle files": fuzz_vehicle,
    "flight logs": fuzz_log,
    "policy files": fuzz_policy,
}
"""What is tried."""

_kept: dict = {}


def _cached(name, make):
    if name not in _kept:
        _kept[name] = make()
    return _kept[name]


def _hostile_options(rng, chosen, names):
    arguments = []
    for name in chosen:
        if rng.random() < 0.05:
            name = changed_text(rng, name).replace("\x00", "")
        if rng.random() < 0.1:
            name = rng.choice(names).replace("_", "-")
        arguments.append(name)
        arguments += [rng.choice(VALUES) for _ in range(rng.choice((0, 1, 1, 1, 1, 1, 2)))]
    return [argument for argument in arguments if argument not in ("-h", "--help")]


def _sample_case():
    from openjax.commands.sample_flights import main

    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        main([f"{folder}/case", "--duration", "4", "--seed", "0"])
        return {path.name: path.read_bytes() for path in Path(folder, "case").iterdir()}


def _write(path, text):
    path.write_bytes(text.encode("utf-8", "replace"))
    return path


@contextlib.contextmanager
def _in(folder: Path) -> Iterator[None]:
    """Work in a folder, so that relative paths of hostile options stay there."""
    before = os.getcwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)
