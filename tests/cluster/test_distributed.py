"""Training on several devices and processes: the same result on the same worlds,
resumed on another number of devices, and one clear line when a process is lost or the
worlds can't be shared out. Virtual CPU devices, processes on loopback.
"""

import os
import re
import signal
import socket
import subprocess
import sys
import time

import pytest

from openjax.cluster.joining import Membership, find_membership
from openjax.errors import UserError
from openjax.runs.request import membership
from openjax.show.metrics import read_metrics
from openjax.store.checkpoint_files import is_checkpoint

pytestmark = pytest.mark.slow

UPDATES = 3
OPTIONS = """
    --preset quick --environment.time_step 0.01 --environment.substeps 1
    --environment.physics mjx --environment.episode_length 20 --environment.capture_radius 1.0
    --network.features 8 --network.heads 1 --network.critic_encoder layers
    --predictor.units 4 --predictor.windows 2
    --predictor.horizons 1 2 --mappo.minibatches 2 --generator.capacity 8
    --first_flights.updates 0 --generator.success_low 0.0 --generator.success_high 1.0 --generator.episodes_per_task 2
    --num_envs 32 --rollout_length 10 --restart_every 2 --restart_steps 10 --total_steps 100000000 --validation_episodes 2
""".split()

# The same run on one device and on four of one process, next to that of two processes
# with two devices each.
ONE_PROCESS = """
import sys
from pathlib import Path
import jax, numpy as np
from openjax.learning import TrainSettings, build, make_start
from openjax.learning.training_step import initial_carry
from openjax.pursuit import Pursuit
from openjax.store.checkpoint_files import load_arrays
from openjax.store.checkpoints import Checkpoints
from openjax.store.leaves import named_leaves, place
from openjax.cluster.devices import carry_shardings, everywhere, make_device_step
from openjax.runs.loop import guarded
from openjax.store.run_directory import RunDirectory

run, directory, UPDATES = RunDirectory(Path(sys.argv[1])), Path(sys.argv[2]), int(sys.argv[3])
settings = run.read_settings()
environment = Pursuit(settings.environment)
parts = build(settings, environment)
shapes = jax.eval_shape(lambda: initial_carry(settings, parts, jax.random.key(0)))
compilations = []
jax.monitoring.register_event_duration_secs_listener(
    lambda name, *_, **__: compilations.append(name) if "backend_compile" in name else None
)


def step_on(number):
    same, step = everywhere(number), guarded(make_device_step(settings, parts, number))
    return jax.jit(step, donate_argnums=0, out_shardings=(carry_shardings(number), same, same))


def restored(checkpoints, number):
    at = jax.tree.broadcast(carry_shardings(number), shapes)
    abstract = jax.tree.map(lambda s, at: jax.ShapeDtypeStruct(s.shape, s.dtype, sharding=at), shapes, at)
    carry, record = checkpoints.restore_latest(abstract)
    assert len(carry.state.step.sharding.device_set) == number
    return carry, record.update


def assert_close(path, other):
    # The devices' sums come in another order, so bits differ; the updates since then widen that a little.
    ours, theirs = load_arrays(path), load_arrays(other)
    assert ours.keys() == theirs.keys() and int(theirs["archive/size"]) == 8
    for name, leaf in ours.items():
        if name != "key":
            scale = 1e-3 * max(1.0, float(np.abs(np.asarray(leaf, np.float64)).max(initial=0.0)))
            np.testing.assert_allclose(theirs[name], leaf, rtol=0, atol=scale, err_msg=name)


last = f"{UPDATES:09d}"
one, four = (Checkpoints(directory / name, keep_last=UPDATES) for name in ("one", "four"))
step_one, carry = step_on(1), place(make_start(settings, parts)(jax.random.key(settings.seed)))
for update in range(1, UPDATES + 1):
    carry, metrics, broken = step_one(carry)
    one.save(update, carry)
    if update == 1:
        four.save(update, carry)
one.wait()

step, (carry, update) = step_on(4), restored(four, 4)  # from one device to four
carry, metrics, broken = step(carry)
before = len(compilations)
for update in range(update + 2, UPDATES + 1):
    carry, metrics, broken = step(carry)
assert before > 1 and len(compilations) == before and not broken.any()
four.save(UPDATES, carry)
four.wait()
assert_close(one.directory / last, four.directory / last)
assert_close(one.directory / last, run.checkpoints / last)

again, _ = restored(four, 1)  # from four devices to one
for name, leaf in named_leaves(carry).items():
    if name != "key":
        np.testing.assert_array_equal(leaf, named_leaves(again)[name], err_msg=name)

before = len(compilations)
carry, update = restored(Checkpoints(run.checkpoints), 1)  # from the two processes, one of them killed, to one device
carry, metrics, broken = step_one(carry)
assert int(carry.update) == update + 1 > UPDATES and not broken.any()
print("same")
"""

# Both wait for each other for ever.
WAITING = """
import sys, threading
from openjax.cluster.joining import Membership, join

membership = Membership(sys.argv[1], 2, int(sys.argv[2]), "deactivate")
with join(membership) as processes:
    import jax
    assert jax.device_count() == 2 and jax.process_index() == membership.process_id
    assert processes.everyone(membership.process_id) == [0, 1] and processes.of_first(5 + membership.process_id) == 5
    print("here", flush=True)
    processes.everyone() if membership.process_id else threading.Event().wait()
"""


def environment_with(devices):
    """The suite's own, with virtual devices, which may have threads as in a user's
    run.
    """
    flags = os.environ["XLA_FLAGS"].replace("--xla_cpu_multi_thread_eigen=false", "")
    flags += f" --xla_force_host_platform_device_count={devices}"
    return {**os.environ, "XLA_FLAGS": flags}


def free_address():
    """A port on loopback that is free."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        return f"127.0.0.1:{server.getsockname()[1]}"


def wait_for(happened, processes, seconds=480.0):
    deadline = time.monotonic() + seconds
    while not happened():
        assert time.monotonic() < deadline and all(process.poll() is None for process in processes)
        time.sleep(0.01)


def train(*options, **popen):
    return subprocess.Popen(
        [sys.executable, "-m", "openjax.train", *OPTIONS, *map(str, options)], text=True, **popen
    )


@pytest.fixture(scope="module")
def killed(tmp_path_factory):
    """A run of two processes, the second killed after its first checkpoint: directory,
    the first's end.
    """
    directory = tmp_path_factory.mktemp("job")
    run = directory / "run"
    address = free_address()
    processes = []
    for i in range(2):
        job = ("--coordinator_address", address, "--num_processes", 2, "--process_id", i)
        options = (*job, "--devices", "all", "--out", run, "--validation_interval", UPDATES)
        with open(directory / f"{i}.out", "w") as out, open(directory / f"{i}.err", "w") as err:
            processes.append(train(*options, env=environment_with(2), stdout=out, stderr=err))
    try:
        wait_for(lambda: is_checkpoint(run / "checkpoints" / f"{UPDATES:09d}"), processes)
        processes[1].send_signal(signal.SIGKILL)
        status = processes[0].wait(480)
    finally:
        for process in processes:
            process.kill()
            process.wait()
    return (run, status, (directory / "0.err").read_text(), (directory / "1.out").read_text())


def test_lost_process_ends_the_others_with_one_line(killed):
    run, status, error, _ = killed
    assert status == 1
    pattern = rf"error: process 1 of 2 \(on \S+\) was lost: .*; go on with .* --resume {re.escape(str(run))} --devices all\n"
    assert re.fullmatch(pattern, error), error


def test_only_the_first_process_writes_and_shows(killed):
    run, _, _, other = killed
    shown = (
        "compiling",
        "training",
        "validation",
        "steps/s",
    )  # what the first one tells, beside libraries' notes
    assert not [word for word in shown if word in other], other
    updates = [record["update"] for record in read_metrics(run / "metrics.jsonl", "train")]
    assert updates[:UPDATES] == [1, 2, 3] and len(set(updates)) == len(updates)


def test_any_number_of_devices_and_processes_trains_alike_and_goes_on_from_each_other(
    killed, tmp_path
):
    command = [sys.executable, "-c", ONE_PROCESS, str(killed[0]), str(tmp_path), str(UPDATES)]
    done = subprocess.run(command, env=environment_with(4), capture_output=True, text=True)
    assert done.returncode == 0 and "same" in done.stdout, done.stderr[-3000:]


def test_worlds_that_cannot_be_shared_out_are_an_error_of_one_line(tmp_path):
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = train("--devices", "all", "--out", tmp_path / "run", env=environment_with(3), **pipes)
    _, error = process.communicate()
    assert process.returncode == 2
    assert (
        error
        == "error: num_envs 32 can't be shared out to 3 devices; 48 could, or --devices 1 or 2\n"
    )
    assert not (tmp_path / "run").exists()


def test_the_loss_of_process_0_is_told_by_the_others():
    address = free_address()
    first, other = (
        subprocess.Popen(
            [sys.executable, "-c", WAITING, address, str(i)],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for i in range(2)
    )  # fmt: skip
    assert first.stdout.readline() == other.stdout.readline() == "here\n"
    time.sleep(2.0)  # JAX, too, looks after its coordinator by now
    first.kill()
    _, error = other.communicate(timeout=480)
    first.communicate()
    assert other.returncode == 1
    assert re.fullmatch(
        r"error: process 0 of 2 \(on \S+\) was lost: .*; start it again\n", error
    ), error


SLURM = {
    "SLURM_JOB_ID": "7",
    "SLURM_STEP_NODELIST": "gpu[03-04]",
    "SLURM_NTASKS": "2",
    "SLURM_PROCID": "1",
    "SLURM_LOCALID": "0",
}
OPEN_MPI = {
    "OMPI_MCA_orte_hnp_uri": "8192.0;tcp://10.0.0.1,10.1.0.1:34911",
    "OMPI_COMM_WORLD_SIZE": "2",
    "OMPI_COMM_WORLD_RANK": "1",
    "OMPI_COMM_WORLD_LOCAL_RANK": "1",
}


@pytest.mark.parametrize(
    ("variables", "arguments", "expected"),
    [
        ({}, (None, None, None, True), None),
        ({}, ("host:1234", 2, 1, True), Membership("host:1234", 2, 1, "deactivate")),
        ({}, ("host:1234", 1, 0, True), None),
        (SLURM, (None, None, None, True), Membership("gpu03:61447", 2, 1, "slurm")),
        (SLURM, (None, None, None, False), None),
        (SLURM, ("host:1234", 4, 3, True), Membership("host:1234", 4, 3, "deactivate")),
        (OPEN_MPI, (None, None, None, True), Membership("10.0.0.1:61442", 2, 1, "ompi")),
    ],
)
def test_membership_comes_from_the_command_line_or_the_manager(
    monkeypatch, variables, arguments, expected
):
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    assert find_membership(*arguments) == expected


def test_membership_is_read_with_dashes_and_underscores():
    for text in (
        "--devices=all --num-processes 2 --process-id=1",
        "--devices all --num_processes=2 --process_id 1",
    ):
        found = membership([*text.split(), "--coordinator_address", "host:1234"])
        assert found == Membership("host:1234", 2, 1, "deactivate")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("host:1234", 2, None, True), "go together"),
        (("host", 2, 0, True), "host:port"),
        (("host:1234", 2, 2, True), "--process_id 2"),
        (("host:1234", 2, 0, False), "--devices all"),
    ],
)
def test_membership_that_makes_no_sense(arguments, complaint):
    with pytest.raises(UserError, match=complaint):
        find_membership(*arguments)
