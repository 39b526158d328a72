"""Joining a job of several processes: which place this one has, and the connections
between them.
"""

import atexit
import contextlib
import dataclasses
import json
import os
import socket
import threading
import time
from collections.abc import Iterator

from openjax.cluster.processes import Peer, Processes, encode
from openjax.errors import UserError

JOIN = 300.0
"""Seconds to wait for all processes at the start."""
LINE = 1000
"""Bytes of the longest greeting."""

_MANAGERS = ("slurm", "ompi")
_BY_HAND = "deactivate"


@dataclasses.dataclass(frozen=True)
class Membership:
    """This process' place in a job of several."""

    coordinator_address: str
    """host:port of process 0; JAX's coordinator gets the port after it."""
    num_processes: int
    process_id: int
    detection: str
    """The system that JAX asks for this process' devices: `slurm`, `ompi`, or `deactivate`
    (all of the host).
    """


def find_membership(
    coordinator_address: str | None,
    num_processes: int | None,
    process_id: int | None,
    all_devices: bool,
) -> Membership | None:
    """This process' place, from the command line or else from Slurm or Open MPI; None:
    it is alone.

    Raises:
      UserError: the three make no sense, or one is missing and nothing else tells it.
    """
    place = (coordinator_address, num_processes, process_id)
    by_hand = any(value is not None for value in place)
    if not by_hand and not all_devices:
        return None
    detection = _BY_HAND
    if None in place:
        detection, place = _detect(place)
    if None in place:
        if not by_hand:
            return None
        raise UserError(
            "--coordinator_address, --num_processes and --process_id go together, "
            "unless Slurm or Open MPI tells what is missing"
        )
    address, number, index = place
    host, _, port = address.rpartition(":")
    if not (host and port.isdecimal() and len(port) <= 5 and 0 < int(port) < 65535):
        raise UserError(
            f"--coordinator_address is {address[:80]!r}; expected host:port of process 0"
        )
    if number < 1 or not 0 <= index < number:
        raise UserError(
            f"--process_id {index} and --num_processes {number}: expected an id from 0 to the "
            "number less one"
        )
    if not all_devices:
        raise UserError(f"{number} processes train on all of their devices; add --devices all")
    return Membership(address, number, index, detection) if number > 1 else None


def _detect(place):
    """The launcher that knows what is missing of address, number and id, and all three, as
    `jax.distributed.initialize` would find them.

    Only its private part tells; the public one joins at once, and the processes' own
    connections come before that.
    """
    from jax._src.clusters import ClusterEnv

    for name in _MANAGERS:
        kind = next((kind for kind in ClusterEnv._cluster_types if kind.name == name), None)
        if kind is not None and kind.is_env_present():
            address, number, index = place
            parameters = ClusterEnv.auto_detect_unset_distributed_params(
                address, number, index, None, name, int(JOIN)
            )
            return name, parameters[:3]
    return _BY_HAND, place


@contextlib.contextmanager
def join(membership: Membership | None) -> Iterator[Processes]:
    """Join the job, before JAX touches a device; leave it together with the others, or
    tell them what went wrong.

    Raises:
      UserError: not all processes came in time, or a port is taken.
    """
    if membership is None:
        yield Processes()
        return
    with _connect(membership) as (connections, address):
        processes = Processes(membership.num_processes, membership.process_id, connections)
        _tune_alone()
        try:
            import jax

            jax.distributed.initialize(
                coordinator_address=address,
                num_processes=membership.num_processes,
                process_id=membership.process_id,
                cluster_detection_method=membership.detection,
            )
            yield processes
            # JAX's own barrier would not wait as long as process 0 draws
            processes.everyone()
            jax.distributed.shutdown()
            processes.leave()
        except BaseException as error:
            if isinstance(error, UserError):
                status = 2
                reason = _one_line(error)
            elif isinstance(error, KeyboardInterrupt):
                status = 130  # as a shell tells a process that SIGINT ended: 128 + 2
                reason = "interrupted"
            else:
                processes.await_verdict()
                status = 1
                reason = f"{type(error).__name__}: {_one_line(error)}"
            processes.fail(status, reason)
            # JAX would wait for the others at exit; once this error is told, nothing is
            # left to do.
            atexit.register(os._exit, status)
            raise


def _tune_alone():
    """Have XLA choose its GPU kernels in each process by itself. Shared, all processes
    wait for each other's choices in every program, also in one that only process 0
    compiles.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_gpu_shard_autotuning" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_gpu_shard_autotuning=false".strip()


def _one_line(error):
    return " ".join(str(error).split())[:500]


@contextlib.contextmanager
def _connect(membership):
    """Connections by process (to all others on process 0, to process 0 elsewhere), and
    where JAX is to look for its coordinator: at the port after process 0's own.
    """
    host, _, port = membership.coordinator_address.rpartition(":")
    host = host.strip("[]")
    port = int(port)
    if membership.process_id != 0:
        connection = _call(host, port, membership)
        with _held_open(host, port + 1) as address:
            yield {0: connection}, address
        return
    _listen(port + 1).close()  # JAX would say in many lines that it's taken
    with _listen(port) as server:
        yield _accept(server, membership.num_processes), f"localhost:{port + 1}"


def _listen(port):
    """A server on all of this host's addresses. Raises UserError where the port is
    taken.
    """
    # hosts of a cluster may name each other by either kind of address
    both = socket.has_dualstack_ipv6()
    try:
        return socket.create_server(
            ("", port), family=socket.AF_INET6 if both else socket.AF_INET, dualstack_ipv6=both
        )
    except OSError as error:
        raise UserError(
            f"the coordinator's port {port} can't be used: {error.strerror or error}"
        ) from None


@contextlib.contextmanager
def _held_open(host, port):
    """An address on this host that leads to another one, and whose connections stay
    open when that is gone.

    JAX ends a process at once, by a stack trace, when its connection to the coordinator
    closes; like this the process has time to say in one line what happened, which it
    learns from its own connection.
    """

    def serve():
        with contextlib.suppress(OSError):
            while True:
                client, _ = server.accept()
                try:
                    server_end = socket.create_connection((host, port), timeout=10.0)
                except OSError:  # refused: JAX tries again
                    client.close()
                    continue
                server_end.settimeout(None)
                for source, sink in ((client, server_end), (server_end, client)):
                    threading.Thread(target=_pump, args=(source, sink), daemon=True).start()

    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=serve, daemon=True).start()
        yield f"127.0.0.1:{server.getsockname()[1]}"


def _pump(source, sink):
    with contextlib.suppress(OSError):
        while data := source.recv(1 << 16):
            sink.sendall(data)


def _call(host, port, membership):
    """The connection to process 0; waits until all processes have come."""
    deadline = time.monotonic() + JOIN
    place = {"process": membership.process_id, "of": membership.num_processes}
    while True:
        reason = "it went away, or counts another number of processes"
        try:
            connection = socket.create_connection((host, port), timeout=10.0)
            connection.sendall(encode({**place, "host": socket.gethostname()}))
            connection.settimeout(max(deadline - time.monotonic(), 1.0))
            reader = connection.makefile("rb")
            if welcome := reader.readline(LINE):
                return Peer(connection, reader, json.loads(welcome)["host"])
        except OSError as error:
            reason = str(error.strerror or error)
        if time.monotonic() > deadline:
            raise UserError(
                f"process 0 can't be reached at {host}:{port} within {JOIN:.0f} s: {reason}"
            )
        # process 0 may not have started yet
        time.sleep(0.2)


def _accept(server, number):
    """Connections to all others, by process."""
    others: dict[int, Peer] = {}
    deadline = time.monotonic() + JOIN
    while len(others) < number - 1:
        server.settimeout(max(deadline - time.monotonic(), 0.01))
        try:
            connection, _ = server.accept()
        except TimeoutError:
            absent = ", ".join(str(i) for i in range(1, number) if i not in others)
            raise UserError(
                f"process {absent} of {number} didn't join within {JOIN:.0f} s"
            ) from None
        connection.settimeout(10.0)
        reader = connection.makefile("rb")
        # a stranger
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            greeting = json.loads(reader.readline(LINE))
            other = greeting["process"]
            if greeting["of"] == number and 1 <= other < number and other not in others:
                others[other] = Peer(connection, reader, str(greeting["host"]))
                continue
        connection.close()
    # only now: the welcome tells each that all have come
    for other in others.values():
        other.socket.sendall(encode({"host": socket.gethostname()}))
    return others
