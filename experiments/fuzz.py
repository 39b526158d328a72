"""Hostile input, damaged checkpoints, kills at any instant: what openjax makes of them.

    python experiments/fuzz.py [--cases 10000] [--damages 200] [--kills 30] [--workers N] [--out experiments/results/fuzz]

* Cases, in process, seeds fixed: command lines, settings, layouts, effects, vehicles, logs and policy files, changed
  at random. Each must be refused in one line or accepted with sane values; a traceback, an odd value that is accepted,
  a file left behind, 30 s or 1 GB more of memory is a failure.
* Damages: a checkpoint of a tiny run gets bits flipped, bytes cut, files deleted; what is restored must be bit for bit
  what was saved in it or in the one before.
* Kills: a tiny training run is killed (SIGKILL) at instants spread over its whole life; `--resume`, or where there is
  nothing to resume the same command, must bring it to the bits of the run that nobody killed.
"""

import contextlib
import dataclasses
import gzip
import io
import json
import math
import os
import random
import resource
import shutil
import signal
import string
import subprocess
import sys
import tempfile
import time
import traceback
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import tyro

from openjax.commands.command_line import LONGEST, one_line, quiet_libraries

SECONDS, MEGABYTES = 30.0, 1000.0

TINY = """--preset quick --environment.episode_length 20 --environment.physics rigid --environment.capture_radius 1.0
    --network.features 8 --network.heads 2 --predictor.units 4 --predictor.windows 2 --predictor.steps 1
    --predictor.horizons 1 2 --mappo.minibatches 2 --mappo.epochs 1 --generator.capacity 8
    --generator.episodes_per_task 2 --num_envs 16 --rollout_length 10 --validation_episodes 2 --validation_interval 20
    --layout_episodes 1""".split()


@dataclasses.dataclass(frozen=True)
class FuzzCommand:
    """Try hostile input, damaged checkpoints and kills."""

    cases: int = 10_000
    """Changed inputs."""
    damages: int = 200
    """Damaged checkpoints."""
    kills: int = 30
    """Instants at which a run is killed."""
    updates: int = 200
    """Updates of the run that is killed."""
    workers: int = os.cpu_count() or 1
    """Processes."""
    seed: int = 0
    out: Path = Path(__file__).parent / "results" / "fuzz"
    """Results are written to this path with .json and .md."""


# What stands in for a good value.
VALUES: tuple = (
    "nan", "inf", "-inf", "-1", "0", "1", "0.5", "-0.0", "1e-30", "1e30", "1e308", "-1e308", "1e400", str(10**20),
    str(-(10**20)), "9" * 5000, "", " ", "x", "None", "true", "False", "[]", "[[", "{}", "--", "-", "--seed", "0x10", "1_000",
    "1,5", "½", "٣", "\u2028", "\U0001f681", "a" * 3000, "/", "/dev/null", "/proc/self/mem", "..", "missing.toml", "2147483648",
    "4294967296", "80000000000", "1 2 3", "\ud800",
)  # fmt: skip


def nasty_value(rng: random.Random):
    """A value for a JSON or TOML entry that has no business there."""
    return rng.choice((
        math.nan, math.inf, -math.inf, -1, 0, 1, 0.5, -1e-9, 1e30, -1e30, 10**30, 2**63, "", "x", "nan", None, True, False,
        [], [1], [[1.0]], {}, {"a": 1}, [math.nan] * 3, 10**9, 1e-9, "a" * 1000,
    ))  # fmt: skip


def changed_text(rng: random.Random, text: str) -> str:
    """A text with a few characters, words or lines changed."""
    for _ in range(rng.randint(1, 4)):
        at = rng.randrange(len(text) + 1)
        kind = rng.randrange(8)
        if kind == 0:
            text = text[:at]
        elif kind == 1:
            text = text[:at] + rng.choice(string.printable + "é–\x00") + text[at + 1 :]
        elif kind == 2:
            text = text[:at] + rng.choice(VALUES).encode("utf-8", "replace").decode() + text[at:]
        elif kind == 3:
            lines = text.splitlines(keepends=True) or [""]
            line = rng.randrange(len(lines))
            lines[line] = lines[line] * rng.choice((0, 2, 50))
            text = "".join(lines)
        elif kind == 4:
            text = text[:at] + "[" * rng.choice((1, 40, 3000)) + text[at:]
        elif kind == 5:
            words = text.split(" ")
            words[rng.randrange(len(words))] = rng.choice(VALUES).encode("utf-8", "replace").decode()
            text = " ".join(words)
        elif kind == 6:
            text = text.replace("\n", rng.choice(("\r", "\r\n", "\n\n", " ")))
        else:
            digits = [i for i, character in enumerate(text) if character.isdigit()]
            if digits:
                at = rng.choice(digits)
                text = text[:at] + rng.choice(("e", "-", "99999999", ".", "nan", "")) + text[at + 1 :]
    return text


def changed_bytes(rng: random.Random, content: bytes) -> bytes:
    """Bytes with bits flipped, an end cut off, or a piece repeated."""
    data = bytearray(content)
    kind = rng.randrange(4)
    if kind == 0:
        return bytes(data[: rng.randrange(len(data) + 1)])
    if kind == 1:
        at = rng.randrange(len(data))
        data[at:at] = data[at : at + rng.choice((1, 10, 1000))]
    for _ in range(rng.choice((1, 1, 1, 2, 20))):
        # most of what can go wrong in an archive lies at its members' ends
        at = rng.randrange(len(data)) if rng.random() < 0.5 else rng.randrange(min(4096, len(data)))
        data[at] ^= 1 << rng.randrange(8)
    return bytes(data)


def changed_values(rng: random.Random, plain):
    """Nested plain values with one or two of them changed, added or left out."""
    plain = json.loads(json.dumps(plain))
    for _ in range(rng.choice((1, 1, 2))):
        node = plain
        while isinstance(node, dict) and node:
            key = rng.choice(list(node))
            if isinstance(node[key], dict) and rng.random() < 0.9:
                node = node[key]
                continue
            kind = rng.random()
            if kind < 0.8:
                node[key] = nasty_value(rng)
            elif kind < 0.9:
                del node[key]
            else:
                node[rng.choice(("", "x", key + "_", "é"))] = nasty_value(rng)
            break
    return plain


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


# Each of these makes one hostile input in an empty folder and hands it in. It returns what was accepted; whatever a
# user would see in one line is raised.


def fuzz_train(rng: random.Random, folder: Path):
    from openjax.cluster.processes import Processes
    from openjax.commands.command_line import option_names
    from openjax.commands.training_command import TrainCommand, membership, prepare, read_command
    from openjax.learning import abstract_carry

    names = _cached("train options", lambda: option_names(TrainCommand()))
    chosen = rng.choices(names, k=rng.randint(1, 3))
    # a folder of our own unless the option is about one
    arguments = [] if {"--out", "--resume"} & set(chosen) else ["--out", str(folder / "run")]
    arguments += _hostile_options(rng, chosen, names)
    with _in(folder), contextlib.redirect_stdout(io.StringIO()):
        if membership(arguments) is not None:
            return None  # of several processes; whether they meet is not asked here
        job, _, _ = prepare(read_command(arguments), arguments, 0.0, Processes())
        abstract_carry(job.settings, job.environment)  # what was accepted can be built
    return job.settings


def fuzz_evaluate(rng: random.Random, folder: Path):
    from openjax.commands.command_line import option_names, parse
    from openjax.evaluate import PROGRAM, EvaluateCommand, prepare

    names = _cached("evaluate options", lambda: option_names(EvaluateCommand()))
    arguments = _hostile_options(rng, rng.choices(names, k=rng.randint(1, 3)), names)
    with _in(folder), contextlib.redirect_stdout(io.StringIO()):
        command = parse(EvaluateCommand, EvaluateCommand(), arguments, PROGRAM)
        return [own.environment for own, *_ in prepare(command, arguments)]


def fuzz_benchmark(rng: random.Random, folder: Path):
    from openjax.benchmark import PROGRAM, BenchmarkCommand
    from openjax.commands.command_line import option_names, parse

    names = _cached("benchmark options", lambda: option_names(BenchmarkCommand()))
    arguments = _hostile_options(rng, rng.choices(names, k=rng.randint(1, 3)), names)
    with _in(folder), contextlib.redirect_stdout(io.StringIO()):
        return parse(BenchmarkCommand, BenchmarkCommand(), arguments, PROGRAM).settings


def fuzz_settings(rng: random.Random, folder: Path):
    from openjax.learning import preset
    from openjax.store.run_directory import RunDirectory
    from openjax.store.settings_files import to_plain

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
    slots, number = len(scenario.pillars), len(scenario.pursuers)
    return scenario_task(PursuitSettings(min_pillars=0, max_pillars=slots, num_pursuers=number), scenario)


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
    """The archive written anew with a member changed: its header, its numbers, its settings."""
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
            text = (
                f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({rng.choice((10**9, 10**30, -5))},), }}"
            )
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


KINDS: dict[str, tuple[Callable, int]] = {
    "training command lines": (fuzz_train, 10),
    "evaluation command lines": (fuzz_evaluate, 3),
    "benchmark command lines": (fuzz_benchmark, 2),
    "settings files": (fuzz_settings, 24),
    "layouts": (fuzz_layout, 20),
    "effects files": (fuzz_effects, 14),
    "vehicle files": (fuzz_vehicle, 16),
    "flight logs": (fuzz_log, 2),
    "policy files": (fuzz_policy, 9),
}
"""What is tried, and its share of the cases."""

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
    from openjax.sample_flights import main

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


def try_case(kind: str, seed: int) -> tuple[str, str]:
    """One case: `refused`, `accepted` or `failed`, and what is to be told of it."""
    function = KINDS[kind][0]
    rng = random.Random(f"{kind} {seed}")
    memory, started = _megabytes(), time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "work"
        place.mkdir()
        try:
            with contextlib.redirect_stderr(io.StringIO()):
                accepted = function(rng, place)
            outcome, told = "accepted", ""
            if not finite(accepted):
                outcome, told = "failed", "nonsense accepted: a number that isn't finite"
        except Exception as error:
            told = one_line(error)
            outcome = "refused"
            if told is None or "\n" in told or not told or len(told) > LONGEST:
                outcome, told = "failed", "".join(traceback.format_exception(error))[-2000:]
        left = [
            str(path) for path in place.rglob("*") if path.name.startswith(".writing") or path.name == "run"
        ]
        if left:
            outcome, told = "failed", f"left behind: {left[:3]}"
    if time.process_time() - started > SECONDS:
        outcome, told = "failed", f"took {time.process_time() - started:.0f} s ({told})"
    if _megabytes() - memory > MEGABYTES:
        outcome, told = "failed", f"took {_megabytes() - memory:.0f} MB ({told})"
    return outcome, told


def _megabytes():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def try_cases(kind: str, seeds: range) -> list[tuple[str, int, str, str]]:
    """Several cases: kind, seed, outcome, text."""
    if kind not in _kept:  # what is loaded for the first of its kind isn't that case's fault
        _kept[kind] = try_case(kind, -1)
    return [(kind, seed, *try_case(kind, seed)) for seed in seeds]


def plan(cases: int, seed: int, piece: int = 20) -> list[tuple[str, range]]:
    """The cases, in pieces that one process does at a time."""
    total = sum(share for _, share in KINDS.values())
    pieces = []
    for kind, (_, share) in KINDS.items():
        number = max(1, round(cases * share / total))
        first = seed * 1_000_000
        pieces += [
            (kind, range(i, min(i + piece, first + number))) for i in range(first, first + number, piece)
        ]
    return pieces


def make_checkpoints(folder: Path) -> None:
    """Two checkpoints of a tiny training carry in `folder`/checkpoints, and all their bits in `folder`/UPDATE.npz."""
    import jax

    from openjax.learning import init_carry
    from openjax.store.checkpoints import Checkpoints, named_leaves, place

    checkpoints = Checkpoints(folder / "checkpoints")
    for update in (1, 2):
        carry = place(init_carry(_tiny_settings(), jax.random.key(update)))
        np.savez(
            folder / f"{update}.npz", **{name: _plain(leaf) for name, leaf in named_leaves(carry).items()}
        )
        checkpoints.save(update, carry, score=float(update), notes={"seconds": 1.0})
    checkpoints.wait()


def _tiny_settings():
    from openjax.commands.training_command import read_command

    return read_command(TINY).settings


def try_damages(folder: Path, seeds: range) -> list[str]:
    """Damage the newest checkpoint (now and then either) and restore: `same`, `before`, `refused` or what went wrong."""
    from openjax.errors import UserError
    from openjax.learning import abstract_carry
    from openjax.store.checkpoints import Checkpoints, abstract_like, named_leaves

    saved = {update: dict(np.load(folder / f"{update}.npz")) for update in (1, 2)}
    abstract = abstract_like(abstract_carry(_tiny_settings()))
    outcomes = []
    for seed in seeds:
        rng = random.Random(f"damage {seed}")
        with tempfile.TemporaryDirectory() as scratch:
            copy = Path(scratch) / "checkpoints"
            shutil.copytree(folder / "checkpoints", copy)
            files = sorted(path for path in copy.rglob("*") if path.is_file())
            newest = [path for path in files if "000000002" in str(path)]
            file = rng.choice(files if rng.random() < 0.1 else newest)
            before = file.read_bytes()
            if rng.random() < 0.1:
                file.unlink()
            else:
                file.write_bytes(changed_bytes(rng, before) if before else b"x")
            try:
                found = Checkpoints(copy)
                carry, record = found.restore_latest(abstract)
                leaves, best = found.load_best("policy/", lambda text: None)
                good = all(
                    _plain(leaf).tobytes() == saved[record.update][name].tobytes()
                    for name, leaf in named_leaves(carry).items()
                ) and all(
                    leaf.tobytes() == saved[best.update][name].tobytes() for name, leaf in leaves.items()
                )
                outcomes.append("silently wrong" if not good else "same" if record.update == 2 else "before")
            except UserError:
                outcomes.append("refused")
            except Exception as error:
                outcomes.append(f"traceback: {type(error).__name__}")
    return outcomes


def _plain(leaf):
    """A leaf as an array on the host, keys by their data."""
    import jax
    import jax.numpy as jnp

    return np.asarray(jax.random.key_data(leaf) if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key) else leaf)


def train(
    run: Path, updates: int, *options: str, cache: Path, kill_after: float | None = None
) -> tuple[int, float, str]:
    """A tiny run in its own process: its status, seconds and errors; killed after so many seconds."""
    steps = str(updates * 16 * 10)
    command = [sys.executable, "-m", "openjax.train"]
    command += (
        list(options) if "--resume" in options else [*TINY, "--steps", steps, "--out", str(run), *options]
    )
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(cache), "JAX_PLATFORMS": "cpu"}
    environment["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"
    started = time.monotonic()
    with tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(
            command, env=environment, stdout=subprocess.DEVNULL, stderr=errors, text=True
        )
        try:
            process.wait(kill_after)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.wait()
        errors.seek(0)
        return process.returncode, time.monotonic() - started, errors.read()[-500:]


def result_of(run: Path) -> dict[str, bytes]:
    """All bits of the last training state and of the policy of a run."""
    from openjax.store.checkpoints import Checkpoints, load_arrays
    from openjax.store.policy_files import load_policy_file

    record = Checkpoints(run / "checkpoints").latest()
    state = {name: leaf.tobytes() for name, leaf in load_arrays(record.path).items()}
    policy = {
        f"policy.npz {name}": leaf.tobytes() for name, leaf in load_policy_file(run / "policy.npz")[0].items()
    }
    return {"update": str(record.update).encode(), **state, **policy}


def try_kill(folder: Path, updates: int, seconds: float, expected: dict, cache: Path) -> dict:
    """Kill a run after some seconds and let it go on as a user would."""
    run = folder / f"killed_{seconds:.2f}"
    status, _, _ = train(run, updates, cache=cache, kill_after=seconds)
    facts = {"seconds": round(seconds, 2), "killed": status == -signal.SIGKILL}
    facts["checkpoints"] = len(list((run / "checkpoints").glob("*.sha256")))
    options = ("--resume", str(run)) if (run / "settings.json").exists() else ()
    facts["went_on_by"] = "--resume" if options else "the same command"
    if status == 0:
        facts["went_on_by"] = "had ended"
    else:
        status, _, errors = train(run, updates, *options, cache=cache)
        if status != 0:
            return {**facts, "outcome": f"failed with {status}: {errors}"}
    found = result_of(run)
    different = [name for name in expected if found.get(name) != expected[name]]
    shutil.rmtree(run)
    return {**facts, "outcome": f"other bits in {different[:3]}" if different else "the same bits"}


def main(command: FuzzCommand) -> dict:
    """Everything that was asked for; returns the results that are written."""
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    os.environ.setdefault("XLA_FLAGS", "--xla_force_host_platform_device_count=1")
    started = time.monotonic()
    from openjax.commands.machine import describe_machine

    results: dict = {
        "command": "python experiments/fuzz.py " + " ".join(sys.argv[1:]),
        "machine": describe_machine(),
    }

    def write():
        """What is known by now, so that an interrupted run leaves it."""
        results["seconds"] = round(time.monotonic() - started)
        command.out.with_suffix(".json").write_text(json.dumps(results, indent=1) + "\n")
        command.out.with_suffix(".md").write_text(page(results))

    with (
        tempfile.TemporaryDirectory() as folder,
        ProcessPoolExecutor(command.workers, get_context("spawn"), quiet_libraries) as pool,
    ):
        scratch = Path(folder)
        todo = plan(command.cases, command.seed) if command.cases else []
        # enough to do while the run that is to be killed is made; its copies come next
        pieces = [pool.submit(try_cases, *piece) for piece in todo[::3]]
        kills = _submit_kills(pool, scratch, command) if command.kills else []
        if command.damages:
            make_checkpoints(scratch)
        damages = [
            pool.submit(try_damages, scratch, range(first, min(first + 20, command.damages)))
            for first in range(0, command.damages, 20)
        ]
        pieces += [pool.submit(try_cases, *piece) for n, piece in enumerate(todo) if n % 3]
        found = [case for piece in as_completed(pieces) for case in piece.result()]
        results["cases"] = {
            kind: dict(Counter(outcome for name, _, outcome, _ in found if name == kind)) for kind in KINDS
        }
        results["failures"] = [
            {"kind": kind, "seed": seed, "text": text}
            for kind, seed, outcome, text in found
            if outcome == "failed"
        ]
        print(
            f"{len(found)} cases, {len(results['failures'])} failures, {time.monotonic() - started:.0f} s",
            flush=True,
        )
        write()
        results["damages"] = dict(Counter(outcome for piece in damages for outcome in piece.result()))
        print(f"damages: {results['damages']}, {time.monotonic() - started:.0f} s", flush=True)
        write()
        results["kills"] = [kill.result() for kill in kills]
        print(f"kills: {Counter(kill['outcome'] for kill in results['kills'])}", flush=True)
        write()
    return results


def _submit_kills(pool, scratch: Path, command: FuzzCommand) -> list:
    """A run that nobody kills, and the tries to kill it, shared out."""
    cache, whole = scratch / "cache", scratch / "whole"
    train(scratch / "first", command.updates, cache=cache)  # compiles
    status, seconds, errors = train(whole, command.updates, cache=cache)
    if status:
        raise SystemExit(f"the run itself failed: {errors}")
    expected = result_of(whole)
    instants = np.linspace(1.0, seconds, command.kills)
    return [
        pool.submit(try_kill, scratch, command.updates, float(instant), expected, cache)
        for instant in instants
    ]


def page(results: dict) -> str:
    """The results as Markdown."""
    machine = results["machine"]
    lines = [
        "# Hostile input, damaged checkpoints, kills",
        "",
        f"`{results['command']}`, commit {machine['commit']}, {machine['cpu_cores']} cores ({machine['device']}), JAX "
        f"{machine['versions']['jax']}, {results['seconds']} s.",
        "",
        "Inputs changed at random, seeds fixed. Failed: a traceback, a value accepted that isn't finite or lies outside its "
        f"range, a file left behind, more than {SECONDS:.0f} s or {MEGABYTES:.0f} MB.",
        "",
        "| input | tried | refused in one line | accepted | failed |",
        "|---|---|---|---|---|",
    ]
    if not results["failures"] and not any(results["cases"].values()):
        lines = lines[:4]  # no cases were asked for
    total: Counter = Counter()
    for kind, counts in results["cases"].items():
        total.update(counts)
        lines += [_row(kind, counts)] if counts else []
    lines += [_row("all", total)] if total else []
    for failure in results["failures"][:20]:
        lines += [
            "",
            f"Failed: {failure['kind']}, seed {failure['seed']}: `{failure['text'].splitlines()[-1][:300]}`",
        ]
    if results.get("damages"):
        counts = results["damages"]
        told = ", ".join(f"{outcome}: {number}" for outcome, number in counts.items())
        lines += ["", f"Damages to checkpoints: {sum(counts.values())}. {told}."]
        lines += [
            "(same: what was hit held nothing of the state; before: found, and the checkpoint before it restored;"
        ]
        lines += [
            "refused: both were hit, or the only undamaged one was gone, and that is said in one line.)"
        ]
    if results.get("kills"):
        lines += ["", f"Kills (SIGKILL): {len(results['kills'])}, {results['kills'][0]['seconds']} to "]
        lines[-1] += (
            f"{results['kills'][-1]['seconds']} s after the start of a run of that length; then gone on with to its end."
        )
        lines += ["", "| after, s | checkpoints then | went on by | result |", "|---|---|---|---|"]
        for kill in results["kills"]:
            lines.append(
                f"| {kill['seconds']} | {kill['checkpoints']} | {kill['went_on_by']} | {kill['outcome']} |"
            )
    return "\n".join(lines) + "\n"


def _row(kind, counts):
    cells = [sum(counts.values()), *(counts.get(name, 0) for name in ("refused", "accepted", "failed"))]
    return f"| {kind} | " + " | ".join(f"{cell:,}" for cell in cells) + " |"


if __name__ == "__main__":
    main(tyro.cli(FuzzCommand))
