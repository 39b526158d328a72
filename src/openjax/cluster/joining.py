"""Joining a job of several processes: which place this one has, and the connections between them."""

import atexit
import contextlib
import dataclasses
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator

from openjax.cluster import relay
from openjax.cluster.processes import Processes, encoded
from openjax.errors import UserError

JOIN = 300.0
"""Seconds to wait for all processes at the start."""

_MANAGERS = ("slurm", "ompi")
_BY_HAND = "deactivate"


@dataclasses.dataclass(frozen=True)
class Membership:
    """This process' place in a job of several."""

    coordinator_address: str
    """host:port of process 0."""
    num_processes: int
    process_id: int
    detection: str
    """What JAX is to ask for this process' devices: `slurm`, `ompi`, or `deactivate` (all of the host)."""


def find_membership(
    coordinator_address: str | None, num_processes: int | None, process_id: int | None, all_devices: bool
) -> Membership | None:
    """This process' place, from the command line or else from Slurm or Open MPI; None: it is alone.

    Raises:
      UserError: the three make no sense, or one is missing and nothing else tells it.
    """
    given = (coordinator_address, num_processes, process_id)
    by_hand = any(value is not None for value in given)
    if not by_hand and not all_devices:
        return None
    detection = _BY_HAND
    if None in given:
        detection, given = _detected(given)
    if None in given:
        if not by_hand:
            return None
        raise UserError(
            "--coordinator_address, --num_processes and --process_id go together, "
            "unless Slurm or Open MPI tells what is missing"
        )
    address, number, index = given
    host, _, port = address.rpartition(":")
    if not (host and port.isdecimal() and len(port) <= 5 and 0 < int(port) < 65536):
        raise UserError(f"--coordinator_address is {address[:80]!r}; expected host:port of process 0")
    if number < 1 or not 0 <= index < number:
        raise UserError(
            f"--process_id {index} and --num_processes {number}: expected an id from 0 to the number less one"
        )
    if not all_devices:
        raise UserError(f"{number} processes train on all of their devices; add --devices all")
    return Membership(address, number, index, detection) if number > 1 else None


def _detected(given):
    """What is missing of address, number and id, as `jax.distributed.initialize` itself would find it.

    Only its private part tells; the public one joins at once, and the processes' own connections come before that.
    """
    from jax._src.clusters import ClusterEnv

    for name in _MANAGERS:
        kind = next((kind for kind in ClusterEnv._cluster_types if kind.name == name), None)
        if kind is not None and kind.is_env_present():
            found = ClusterEnv.auto_detect_unset_distributed_params(*given, None, name, int(JOIN))
            return name, found[:3]
    return _BY_HAND, given


@contextlib.contextmanager
def joined(membership: Membership | None) -> Iterator[Processes]:
    """Join the job, before JAX touches a device; leave it together with the others, or tell them what went wrong.

    Raises:
      UserError: not all processes came in time, or a port is taken.
    """
    if membership is None:
        yield Processes()
        return
    with connected(membership) as (connections, bind_address):
        processes = Processes(membership.num_processes, membership.process_id, connections)
        _tune_alone()
        try:
            import jax

            jax.distributed.initialize(
                coordinator_address=membership.coordinator_address,
                num_processes=membership.num_processes,
                process_id=membership.process_id,
                cluster_detection_method=membership.detection,
                coordinator_bind_address=bind_address,
            )
            yield processes
            processes.everyone()  # JAX's own barrier would not wait as long as process 0 draws
            jax.distributed.shutdown()
            processes.leave()
        except BaseException as error:
            if isinstance(error, UserError):
                status, reason = 2, _one_line(error)
            elif isinstance(error, KeyboardInterrupt):
                status, reason = 130, "interrupted"
            else:
                processes.await_verdict()
                status, reason = 1, f"{type(error).__name__}: {_one_line(error)}"
            processes.fail(status, reason)
            # JAX would wait for the others at exit; once this error is told, nothing is left to do.
            atexit.register(os._exit, status)
            raise


def _tune_alone():
    """Have XLA choose its GPU kernels in each process by itself. Shared, all processes wait for each other's choices in
    every program, also in one that only process 0 compiles.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_gpu_shard_autotuning" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_gpu_shard_autotuning=false".strip()


def _one_line(error):
    return " ".join(str(error).split())[:500]


@contextlib.contextmanager
def connected(membership):
    """Connections and hosts by process (to all others on process 0, to process 0 elsewhere), and where JAX's
    coordinator is to listen.
    """
    host, _, port = membership.coordinator_address.rpartition(":")
    if membership.process_id != 0:
        yield {0: _call(host.strip("[]"), int(port), membership)}, None
        return
    own = socket.create_server(("127.0.0.1", 0))
    with own, _relay(int(port), own.getsockname()[1]) as coordinator_port:
        yield _accept(own, membership.num_processes), f"127.0.0.1:{coordinator_port}"


@contextlib.contextmanager
def _relay(port, own_port):
    """Start the relay; gives the port that it keeps for JAX's coordinator."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        coordinator_port = free.getsockname()[1]
    process = subprocess.Popen(
        [sys.executable, "-I", relay.__file__, str(port), str(coordinator_port), str(own_port)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C is not for it
    )
    try:
        if not process.stdout.readline():
            raise UserError(f"the coordinator's port {port} can't be used: {process.stderr.read().strip()}")
        yield coordinator_port
    finally:
        process.stdin.close()  # it ends when the others have closed their connections


def _call(host, port, membership):
    """Connection to process 0, and its host; waits until all processes have come."""
    deadline = time.monotonic() + JOIN
    greeting = {
        "process": membership.process_id,
        "of": membership.num_processes,
        "host": socket.gethostname(),
    }
    while True:
        reason = "it went away, or counts another number of processes"
        try:
            connection = socket.create_connection((host, port), timeout=10.0)
            connection.sendall(encoded(greeting))
            connection.settimeout(max(deadline - time.monotonic(), 1.0))
            if welcome := _read_line(connection):
                return connection, json.loads(welcome)["host"]
        except OSError as error:
            reason = str(error.strerror or error)
        if time.monotonic() > deadline:
            raise UserError(f"process 0 can't be reached at {host}:{port} within {JOIN:.0f} s: {reason}")
        time.sleep(0.2)


def _accept(server, number):
    """Connections to all others and their hosts, by process."""
    found: dict[int, tuple[socket.socket, str]] = {}
    deadline = time.monotonic() + JOIN
    while len(found) < number - 1:
        server.settimeout(max(deadline - time.monotonic(), 0.01))
        try:
            connection, _ = server.accept()
        except TimeoutError:
            missing = ", ".join(str(i) for i in range(1, number) if i not in found)
            raise UserError(f"process {missing} of {number} didn't come within {JOIN:.0f} s") from None
        other, host = _greeted(connection, number)
        if other is None or other in found:
            connection.close()  # a stranger, or a second process of that number
        else:
            found[other] = (connection, host)
    for connection, _ in found.values():
        connection.sendall(encoded({"host": socket.gethostname()}))
    return found


def _greeted(connection, number):
    """The number and host of the process that greets; None for a stranger."""
    connection.settimeout(10.0)
    try:
        greeting = json.loads(_read_line(connection))
        other, of, host = greeting["process"], greeting["of"], str(greeting["host"])
        return (other, host) if of == number and 1 <= other < number else (None, host)
    except (OSError, ValueError, KeyError, TypeError):
        return None, None


def _read_line(connection):
    """A short line, byte by byte, as what follows belongs to the link; empty where there is none."""
    line = b""
    while not line.endswith(b"\n"):
        byte = connection.recv(1)
        if not byte or len(line) > 1000:
            return b""
        line += byte
    return line
