"""The commands as a user runs them, tiny: training, kill and resume, evaluation,
benchmark, bad input.
"""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import tempfile
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import openjax
from openjax.command_line import run_command
from openjax.commands import benchmark, diagnose, evaluate, fly, train
from openjax.evaluation.result_tables import FIELDS
from openjax.learning import training_step
from openjax.learning.training_step import Phases, make_phases
from openjax.pursuit import SCENARIOS
from openjax.runs import programs
from openjax.show.metrics import read_metrics
from openjax.store.checkpoint_files import is_checkpoint, load_arrays
from openjax.store.checkpoints import Checkpoints
from openjax.store.policy_files import load_policy_file, shipped_policies

pytestmark = pytest.mark.slow

UPDATES = 24
TINY = (
    "--num_envs 16 --rollout_length 10 --environment.episode_length 20 --environment.physics rigid "
    "--environment.time_step 0.01 --environment.substeps 1 "
    "--network.features 8 --network.heads 1 --network.critic_encoder layers "
    "--predictor.units 4 --predictor.windows 4 --predictor.horizons 1 2 "
    "--mappo.minibatches 2 --generator.capacity 8 "
    "--validation_interval 3 --validation_episodes 4 "
    "--first_flights.updates 1"
).split()
STEPS = ["--steps", str(UPDATES * 160), "--layout_episodes", "4"]
ALONE = ["--compare_with", "none"]


def start(arguments):
    """A command in a process of its own; it says what it compiles.

    Its output goes to a file: it's longer than a pipe holds that nobody reads while the
    run goes on.
    """
    environment = {**os.environ, "JAX_LOG_COMPILES": "1"}
    output = tempfile.TemporaryFile("w+")
    command = [sys.executable, "-m", *arguments]
    process = subprocess.Popen(command, env=environment, stdout=output, stderr=subprocess.STDOUT)
    return process, output


def finish(started, status=0):
    process, output = started
    process.wait(timeout=300)
    output.seek(0)
    printed = output.read()
    assert process.returncode == status, printed
    return printed


@pytest.fixture(scope="session")
def train_arguments(tmp_path_factory):
    """The tiny run, in a simulator with effects and another vehicle, on all devices."""
    directory = tmp_path_factory.mktemp("simulator")
    effects = directory / "effects.toml"
    vehicle = directory / "vehicle.toml"
    effects.write_text(
        "[rotor_drag]\nd_xy = 0.01\n[command_latency]\ndelay = { value = 0.02, unit = 's' }\n"
    )
    vehicle.write_text("[vehicle]\nmass = 0.034\n")
    files = ["--effects", str(effects), "--vehicle", str(vehicle)]
    return ["openjax.train", *TINY, *STEPS, *files, "--devices", "all"]


@pytest.fixture(scope="session")
def whole_run(tmp_path_factory, train_arguments):
    """A run from start to end, and what it printed."""
    out = tmp_path_factory.mktemp("runs") / "whole"
    return out, finish(start([*train_arguments, "--compare_with", "angelani", "--out", str(out)]))


def in_process(main, arguments, monkeypatch, capsys):
    """Exit status and standard error of a command, run here."""
    monkeypatch.setattr(sys, "argv", ["command", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        run_command(main)
    return stop.value.code, capsys.readouterr().err


def test_train_shows_progress_and_leaves_what_the_readme_says(whole_run):
    out, printed = whole_run
    for line in ("loading JAX", "compiling the training step", "(best so far)", "Before and after"):
        assert line in printed
    for name in (
        "settings.json",
        "policy.npz",
        "layouts.json",
        "training.png",
        "trajectories.png",
        "chase.gif",
    ):
        assert (out / name).stat().st_size > 100, name
    assert [r["update"] for r in read_metrics(out / "metrics.jsonl", "train")] == list(
        range(1, UPDATES + 1)
    )
    layouts = json.loads((out / "layouts.json").read_text())
    scenarios = [row["scenario"] for row in layouts["after"]]
    assert scenarios == ["validation", "validation_far", *SCENARIOS]
    assert [row["scenario"] for row in layouts["angelani"]] == [scenarios[0], *scenarios[2:]]
    assert layouts["machine"]["versions"]["jax"] == jax.__version__


def test_minutes_are_of_learning_however_long_the_compiler_takes(tmp_path):
    arguments = [
        *TINY,
        "--first_flights.updates",
        "0",
        "--steps",
        "100000000",
        "--layout_episodes",
        "1",
        *ALONE,
    ]
    finish(
        start(["openjax.train", *arguments, "--minutes", "0.02", "--out", str(tmp_path / "run")])
    )
    learnt = list(read_metrics(tmp_path / "run" / "metrics.jsonl", "train"))
    assert 0 < len(learnt) < 100_000_000 // 160


def test_killed_in_the_middle_of_a_checkpoint_and_resumed_equals_whole(
    whole_run, tmp_path, train_arguments
):
    out = tmp_path / "killed"
    process, _ = start([*train_arguments, *ALONE, "--out", str(out)])
    checkpoints = Checkpoints(out / "checkpoints")
    deadline = time.monotonic() + 200
    while time.monotonic() < deadline and process.poll() is None:
        names = os.listdir(checkpoints.directory) if checkpoints.directory.is_dir() else []
        committed = [name for name in names if name.isdecimal()]
        if len(committed) >= 2 and any("tmp" in name for name in names):
            break
        time.sleep(0.0005)
    process.kill()
    assert process.wait() == -signal.SIGKILL
    reached = checkpoints.latest().update
    assert 0 < reached < UPDATES

    (out / ".writing-1-policy.npz").touch()  # a kill in the middle of another file
    printed = finish(start(["openjax.train", "--resume", str(out), *STEPS[2:]]))
    assert f"resumed at update {reached} of {UPDATES}" in printed
    # the step's two programs are compiled once, also for a restored carry
    for said in (whole_run[1], printed):
        for program in ("fly_and_learn", "begin_episodes"):
            assert said.count(f"Finished XLA compilation of jit({program})") == 1
    assert not list(out.glob(".writing-*"))
    whole = Checkpoints(whole_run[0] / "checkpoints").latest()
    again = checkpoints.latest()
    assert whole.update == again.update == UPDATES
    expected = load_arrays(whole.path)
    arrays = load_arrays(again.path)
    assert len(expected) > 100 and expected.keys() == arrays.keys()
    for name, array in expected.items():
        np.testing.assert_array_equal(array, arrays[name], err_msg=name)
    losses = [
        [(r["update"], r["value_loss"]) for r in read_metrics(path / "metrics.jsonl", "train")]
        for path in (whole_run[0], out)
    ]
    assert losses[0] == losses[1]


@pytest.mark.parametrize("line", ["loading JAX", "compiling the first", "compiling the training"])
def test_signal_before_the_first_update_ends_at_once_and_loses_nothing(
    line, whole_run, tmp_path, train_arguments
):
    out = tmp_path / "stopped"
    process, output = start([*train_arguments, *ALONE, "--out", str(out)])
    while process.poll() is None and line not in _printed(output):
        time.sleep(0.01)
    process.terminate()
    process.wait(timeout=300)
    printed = _printed(output)
    # the step is compiled beside what comes before it: where it's ready by the time of
    # its line, learning has begun, which saves and ends well
    ends = (0, 143) if line == "compiling the training" else (143,)
    assert process.returncode in ends, printed
    assert printed.splitlines()[-1].startswith("SIGTERM: "), printed
    if not (out / "settings.json").exists():
        return
    assert "openjax train --resume" in printed and not list(out.glob(".writing-*"))
    finish(start(["openjax.train", "--resume", str(out)]))
    expected, _, _ = load_policy_file(whole_run[0] / "policy.npz")
    policy, _, _ = load_policy_file(out / "policy.npz")
    for name, array in expected.items():
        np.testing.assert_array_equal(array, policy[name], err_msg=name)


LAST_STAGE = ["--analytic.updates", "3", "--analytic.look_every", "1"]
LAST_STAGE += ["--analytic.worlds", "2"]


@pytest.fixture(scope="session")
def ended_run(tmp_path_factory, train_arguments):
    """A run with a last stage, whole."""
    out = tmp_path_factory.mktemp("runs") / "ended"
    finish(start([*train_arguments, *LAST_STAGE, *ALONE, "--out", str(out)]))
    return out


@pytest.mark.parametrize(
    "line, number",
    [
        ("learning by the gradient", signal.SIGTERM),
        ("evaluating the policy after", signal.SIGINT),
        ("drawing", signal.SIGTERM),
    ],
)
def test_signal_after_the_last_update_loses_nothing(
    line, number, ended_run, tmp_path, train_arguments
):
    """In the last stage and in the report: one line, whole files, and a resumed run
    ends as one that nobody stopped.
    """
    out = tmp_path / "stopped"
    process, output = start([*train_arguments, *LAST_STAGE, *ALONE, "--out", str(out)])
    while process.poll() is None and line not in _printed(output):
        time.sleep(0.01)
    process.send_signal(number)
    process.wait(timeout=300)
    printed = _printed(output)
    # between two updates of the stage the run ends by itself, with what it has learnt
    assert process.returncode in (0, 128 + number), printed
    name = signal.Signals(number).name
    assert printed.splitlines()[-1].startswith(f"{name}: saved at update {UPDATES}"), printed
    assert printed.count(f"{name}: ") == 1 and "Traceback" not in printed
    assert not list(out.rglob(".writing-*"))
    for file in out.glob("*.json"):
        json.loads(file.read_text())
    load_policy_file(out / "policy.npz")
    finish(start(["openjax.train", "--resume", str(out), *STEPS[2:]]))
    expected, _, _ = load_policy_file(ended_run / "policy.npz")
    policy, _, _ = load_policy_file(out / "policy.npz")
    for leaf, array in expected.items():
        np.testing.assert_array_equal(array, policy[leaf], err_msg=leaf)
    whole, resumed = (json.loads((d / "layouts.json").read_text()) for d in (ended_run, out))
    assert whole["after"] == resumed["after"]


def _printed(output):
    """What a process has written so far to its file, whose place is left alone."""
    return os.pread(output.fileno(), 1 << 24, 0).decode(errors="replace")


def test_signal_saves_and_exits_cleanly(whole_run, tmp_path, train_arguments):
    out = tmp_path / "stopped"
    started = start([*train_arguments, *ALONE, "--out", str(out)])
    deadline = time.monotonic() + 200
    while time.monotonic() < deadline and started[0].poll() is None:
        if (out / "metrics.jsonl").exists() and (out / "metrics.jsonl").stat().st_size > 0:
            break
        time.sleep(0.01)
    started[0].terminate()
    printed = finish(started)
    assert "SIGTERM: saved at update" in printed and "--resume" in printed
    logged = [r["update"] for r in read_metrics(out / "metrics.jsonl", "train")]
    assert Checkpoints(out / "checkpoints").latest().update == logged[-1]
    assert (out / "policy.npz").exists()


def test_nan_stops_the_run_and_leaves_the_state(tmp_path, monkeypatch, capsys, train_arguments):
    def make_broken_step(settings, environment, devices, part):
        def step(carry):
            if part is Phases.begin_episodes:
                return carry, {}
            update = carry.update + 1
            broken = jax.tree.map(lambda leaf: leaf + (0.0 / (update != 4)), carry.policy.actor)
            carry = carry.replace(policy=carry.policy.replace(actor=broken))
            return carry.replace(update=update), {"reward": 0.0 * update}

        return step

    monkeypatch.setattr(programs, "make_device_step", make_broken_step)
    out = tmp_path / "broken"
    options = [*train_arguments[1:], *ALONE, "--no-compilation_cache", "--out", out]
    status, _ = in_process(train.main, options, monkeypatch, capsys)
    assert status == 1
    report = json.loads((out / "not_finite" / "report.json").read_text())
    assert report["update"] == 4 and all(
        name.startswith("policy/actor/") for name in report["leaves"]
    )
    assert is_checkpoint(out / "not_finite" / "000000004")
    assert Checkpoints(out / "checkpoints").latest().update == 3


LAYOUT = """
pillars = [[0.0, 0.3], [0.2, -0.2]]
pursuers = [[0.6, 0.0, 0.5], [0.6, 0.3, 0.5], [0.6, -0.3, 0.5]]
evader = [-0.6, 0.0, 0.5]
"""


def test_evaluate_prints_and_writes_the_records(whole_run, tmp_path, monkeypatch, capsys):
    records = tmp_path / "records.json"
    arguments = ["--policy", whole_run[0], "--episodes", "4", "--json", records]
    assert in_process(evaluate.main, [*arguments, "--scenario", "all"], monkeypatch, capsys)[0] == 0
    rows = json.loads(records.read_text())
    assert [tuple(row) for row in rows] == [FIELDS] * 6
    twice = [
        "--policy",
        whole_run[0],
        whole_run[0] / "policy_start.npz",
        "--scenario",
        "wall",
        "--episodes",
        "4",
    ]
    assert in_process(evaluate.main, twice, monkeypatch, capsys)[0] == 0
    layout = tmp_path / "own.toml"
    layout.write_text(LAYOUT)
    for scenario in ("hidden", layout):
        assert (
            in_process(evaluate.main, [*arguments, "--scenario", scenario], monkeypatch, capsys)[0]
            == 0
        )
        row = json.loads(records.read_text())
        assert tuple(row) == FIELDS and row["episodes"] == 4
        if scenario == "hidden":
            assert row == rows[-1]  # alone and among others alike
    assert row["scenario"] == "own"


def test_shipped_policies_act_in_their_game_and_refuse_another():
    assert "open" in shipped_policies()
    kinds = {}
    for name in shipped_policies():
        policy = openjax.load_policy(name)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(policy.parameters)), name
        kinds[policy.policy, policy.settings.environment] = (
            policy  # seeds of one kind act by one program
        )
    for policy in kinds.values():
        policy = policy.of_team(3)
        environment = openjax.make(policy.settings.environment, speed_limit="none")
        observation = jax.eval_shape(environment.reset, jax.random.key(0))[0]
        observation = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), observation)
        action = policy(observation)
        assert action.shape == (3, 4) and bool((abs(action) <= 1).all()), policy.source
    flight = openjax.load_policy("flight")
    for changes in ({"history_length": 3}, {"observe_time": False}):
        other = openjax.make(flight.settings.environment, **changes)
        with pytest.raises(openjax.UserError, match="make its game with"):
            flight(jax.eval_shape(other.reset, jax.random.key(0))[0])


def test_benchmark_writes_table_and_file(tmp_path, monkeypatch, capsys):
    def phases_without(*arguments, **named):  # most of what there is to compile
        phases = make_phases(*arguments, **named)
        return dataclasses.replace(phases, learn=phases.learn[:-1])

    monkeypatch.setattr(training_step, "make_phases", phases_without)
    file = tmp_path / "speed.json"
    arguments = [*TINY, "--predictor.enabled", "False", "--generator.enabled", "False"]
    arguments += ["--parts", "rigid", "training", "--envs", "8", "--training_envs", "14"]
    arguments += ["--steps", "5", "--seconds", "0.1", "--json", file]
    assert benchmark.main([str(argument) for argument in arguments]) == 0
    printed = capsys.readouterr().out
    assert "env steps/s" in printed and "compile" in printed
    result = json.loads(file.read_text())
    parts = [(row["part"], row["num_envs"]) for row in result["rows"]]
    assert parts == [("rigid", 8), ("training", 14), ("- fly", 14), ("- renew", 14)]
    assert all(
        row["env_steps_per_second"] > 0 and row["compile_seconds"] > 0 for row in result["rows"]
    )
    assert {"device", "versions", "commit"} <= result["machine"].keys()


def wrong_layout(change):
    return LAYOUT.replace("[0.0, 0.3]", change)


@pytest.mark.parametrize(
    ("main", "arguments", "message"),
    [
        (
            train,
            "--environment.capture_radios 1",
            "unknown setting --environment.capture_radios; did you mean",
        ),
        (
            train,
            "--environment.num_pursuers 9",
            "num_pursuers is 9; it must be a whole number in [1, 8]",
        ),
        (
            train,
            "--environment.pillar_radius 5",
            "leaves no room in an arena of radius 0.9: less than 0.83",
        ),
        (train, "--mappo.minibatches two", "--mappo.minibatches is 'two'; expected a whole number"),
        (train, "--network.heads 0", "network.heads is 0; it must be a whole number in"),
        (train, "--mappo.learning_rate nan", "mappo.learning_rate is nan; it must be in (0, 1]"),
        (train, "--restart_close 0.5", "restart_close 0.5 needs restart_every"),
        (
            train,
            "--num_envs 16000000 --rollout_length 9600 --environment.episode_length 9600 "
            "--restart_steps 9600",
            "worlds of 9600 steps need at least",
        ),  # more than any machine has
        (train, "--out /proc/run", "can't be written there"),
        (evaluate, "--policy {run} --json {folder}", "is a folder; a file is needed"),
        (train, "--preset huge", "preset huge: no such preset; there are quick, paper"),
        (train, "--out {run}", "already holds a run; --resume"),
        (train, "--out {folder}", "holds files that aren't a run's"),
        (train, "--resume {folder}", "is no run"),
        (
            train,
            "--resume {run} --network.features 16",
            "--network.features can't change when a run is resumed",
        ),
        (train, "--resume {run} --overwrite", "exclude each other"),
        (train, "--effects {folder}/nothing.toml", "nothing.toml"),
        (train, "--vehicle {folder}/nothing.toml", "nothing.toml"),
        (train, "--start_from {folder}", "is no policy"),
        (
            train,
            "--start_from open --environment.observe_in heading",
            "it observes in world, the run in heading",
        ),
        (train, "--compare_with opne", "policy opne: no such file"),
        (train, "--devices 1000", "expected all, or a number up to"),
        (evaluate, "--policy {folder}", "is no policy"),
        (
            evaluate,
            "--policy {run} --scenario nowhere",
            "no such layout, nor a .toml file; there are wall",
        ),
        (evaluate, "--policy {run} --scenario {folder}/outside.toml", "outside the arena"),
        (evaluate, "--policy {run} --scenario {folder}/over.toml", "over the start"),
        (evaluate, "--policy {run} --json {folder}/no/where.json", "doesn't exist"),
        (
            evaluate,
            "--policy {run} --environment.evaders learned",
            "needs a file: give --opponent one that openjax exploit",
        ),
        (
            evaluate,
            "--policy {run} --episode 3",
            "unknown setting --episode; did you mean --episodes?",
        ),
        (benchmark, "--envs 0", "--envs is 0; it must be a whole number in"),
        (diagnose, "{folder} --reference", "--reference needs at least one folder of flights"),
        (fly, "--policy open --motion_capture nobody:poses", "no such MODULE:FUNCTION"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    main, arguments, message, whole_run, tmp_path, monkeypatch, capsys
):
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "outside.toml").write_text(wrong_layout("[2.0, 0.3]"))
    (folder / "over.toml").write_text(wrong_layout("[0.6, 0.0]"))
    run = whole_run[0]
    before = {path: path.stat().st_mtime_ns for path in [*run.rglob("*"), *folder.rglob("*")]}
    monkeypatch.chdir(tmp_path)
    arguments = [argument.format(run=run, folder=folder) for argument in arguments.split()]
    status, error = in_process(main.main, arguments, monkeypatch, capsys)
    assert status == 2
    assert len(error.strip().splitlines()) == 1 and message in error
    assert {
        path: path.stat().st_mtime_ns for path in [*run.rglob("*"), *folder.rglob("*")]
    } == before
    assert os.listdir(tmp_path) == ["folder"]
