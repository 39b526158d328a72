"""One flight of real processes with its fault: `openjax fly` on a terminal of its own,
real cflib over UDP.

At a drawn moment after the take-off a signal goes to a process, a key to the terminal,
nonsense to a vehicle, or what motion capture or the vehicles send is damaged. JAX
doesn't survive a fork: a flight is a fork of its worker that asks it for actions.
"""

import contextlib
import math
import multiprocessing
import os
import pty
import random
import select
import signal
import socket
import sys
import threading
import time
import traceback
from dataclasses import replace
from pathlib import Path

from tests.flying.fault_injection.faults import ENDING, MARGIN, outcome
from tests.flying.fault_injection.process_faults import (
    KEYS,
    ROLES,
    SIGNALS,
    START,
    STOPPED,
    ends_flight,
    fault_of,
)
from tests.flying.fault_injection.remote_game import RemoteGame, feed_of, play

LONGEST = 25.0
"""A flight is given up this long (s) after its fault."""
SETTLE = 1.0
"""What lands over is looked at for so long (s): processes must have ended by then."""


class Flown:
    """One flight with its fault."""

    def __init__(self, number, kind, virtual, arguments, prepared):
        self.fault = fault_of(number, kind)
        self._number = number
        self._kind = kind
        self._virtual = virtual
        session = prepared.session
        if self.fault.captured and kind not in ("none", "second fly"):
            session = replace(session, feed=feed_of(self.fault, virtual.truth))
        self._arguments, self._prepared = arguments, prepared._replace(session=session)
        self._said = b""
        self._open = True
        self._pids = {}
        self._second = ""

    def fly(self) -> dict:
        """What became of it."""
        self._virtual.reset(self.fault)
        ours, theirs = multiprocessing.Pipe()
        game = self._prepared.game
        pid, self._terminal = pty.fork()
        if pid == 0:
            self._prepared = self._prepared._replace(
                game=RemoteGame(game, theirs, self._spoil_play)
            )
            self._child()
        theirs.close()
        threading.Thread(target=play, args=(game, ours), daemon=True).start()
        begin = time.perf_counter()
        status = None
        injected = None
        settled = 0.0
        while True:
            now = time.perf_counter()
            self._drain()
            status = self._ended(pid) if status is None else status
            if injected is None and now - self._virtual.truth.take_off >= max(self.fault.time, 0.0):
                injected = now
                self._find(pid)
                self._inject(pid)
            since = now - (injected or begin)
            over = status is not None and (settled or since > 0.2) and self._landed()
            settled = (settled or now) if over else 0.0
            if (over and now - settled > SETTLE) or since > LONGEST + 25.0 * (injected is None):
                break
        self._clean(pid, status)
        return self._record(status, injected, begin)

    def _child(self):
        """The flight itself, in a fork of the worker with a terminal of its own."""
        from openjax.command_line import run_command
        from openjax.commands.fly import fly

        # the worker's are others: what multiprocessing puts in their place, files
        sys.stdin, sys.stdout, sys.stderr = (
            open(0),
            open(1, "w", buffering=1),
            open(2, "w", buffering=1),
        )

        def main(_):
            fly(self._arguments, self._prepared)

        try:
            run_command(main)
        except SystemExit as stop:
            os._exit(int(stop.code or 0))
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(3)

    def _spoil_play(self, play):
        now = time.perf_counter() - self._virtual.truth.take_off
        if self._kind == "policy fails" and self.fault.on(now):
            raise ValueError("the policy failed")
        return play._replace(action=self.fault.answered(play.action, now))

    def _drain(self):
        if self._open and select.select([self._terminal], [], [], 0.005)[0]:
            try:
                self._said += os.read(self._terminal, 4096)
            except OSError:
                self._open = False
        elif not self._open:
            time.sleep(0.005)

    def _ended(self, pid):
        ended_pid, status = os.waitpid(pid, os.WNOHANG)
        return os.waitstatus_to_exitcode(status) if ended_pid else None

    def _find(self, pid):
        """Process ids by role: links and guard are the loop's children, in this
        order.
        """
        self._pids = {"loop": pid}
        with contextlib.suppress(OSError):
            children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
            spawned = [
                int(c) for c in children if b"spawn_main" in Path(f"/proc/{c}/cmdline").read_bytes()
            ]
            self._pids.update(zip(("links", "guard"), sorted(spawned), strict=False))

    def _inject(self, pid):
        kind = self._kind
        name, _, target = kind.partition(" ")
        if kind in KEYS:
            for wait, keys in enumerate(KEYS[kind].split("…")):
                time.sleep(wait)
                os.write(self._terminal, keys.encode())
        elif kind == "terminal closed":
            os.close(self._terminal)
            self._open = False
        elif " then " in kind:
            first, second = target.split(" then ")
            self._kill(name, first)
            time.sleep(0.05 if second in ROLES else 0.3)
            if second in KEYS:
                os.write(self._terminal, KEYS[second].encode())
            else:
                self._kill(*(("CONT", first) if second == "CONT" else ("KILL", second)))
        elif name in SIGNALS:
            self._kill(name, target)
        elif kind == "strangers' packets":
            self._strangers()
        elif kind == "second fly":
            self._try_second()

    def _kill(self, name, target):
        send, roles = (os.killpg, "loop") if target == "group" else (os.kill, target)
        for role in roles.split("+"):
            with contextlib.suppress(ProcessLookupError, KeyError):
                send(self._pids[role], getattr(signal, f"SIG{name}"))

    def _strangers(self):
        """Scans, echoes, requests and noise from another address; set-points aren't
        among them.
        """
        rng = random.Random(self._number)
        ports = [int(uri.rsplit(":", 1)[1]) for uri in self._virtual.uris]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            for _ in range(300):
                head = rng.choice((0xFF, 0x2C, 0x0C, 0xFC, 0x4C, 0xDC, 0x1C))
                noise = rng.randbytes(rng.randrange(20))
                other.sendto(bytes([head, *noise]), ("127.0.0.1", rng.choice(ports)))

    def _try_second(self):
        from openjax.errors import UserError
        from openjax.flying.endpoints import sole_command

        try:
            with sole_command(self._virtual.uris):
                self._second = "a second one had the vehicles"
        except UserError as error:
            self._second = str(error)

    def _landed(self):
        track = self._virtual.track()
        return not track["armed"][-1].any() or math.isinf(self._virtual.truth.take_off)

    def _clean(self, pid, status):
        """End what is left of this flight, each by its own id."""
        self._left = [r for r, p in self._pids.items() if r != "loop" and _lives(p)]
        for process in self._pids.values():
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        if status is None:
            with contextlib.suppress(ProcessLookupError, ChildProcessError):
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
        if self._open:
            self._drain()
            os.close(self._terminal)

    def _record(self, status, injected, begin) -> dict:
        track = self._virtual.track()
        fault = self.fault
        result = outcome(
            fault, track["time"], track["position"], track["off"].astype(bool), injected or begin
        )
        is_held = result.pop("held")
        lines = [line for line in self._said.decode(errors="replace").splitlines() if line.strip()]
        row = {
            "number": self._number, "kind": self._kind, "time": round(min(max(fault.time, 0.0), 99.0), 2), "status": status,
            "took_off": not math.isinf(self._virtual.truth.take_off), **result, "hard": bool(track["crashed"][is_held].any()),
            "armed": bool(track["armed"][-1][is_held].any()), "left": self._left,
            "second": self._second, "said": " | ".join(lines[1:])[-600:],
        }  # fmt: skip
        return row | {"well": self._well(row)}

    def _well(self, row) -> bool:
        """Whether all went as it must."""
        if self._kind in START:
            return not row["took_off"] and row["status"] == 2
        if (
            not row["took_off"]
            or row["out"] > MARGIN
            or row["armed"]
            or row["status"] is None
            or row["left"]
        ):
            return False
        # the operator wants them to fall
        if any(name in self._kind for name in STOPPED):
            return row["seconds"] is not None and row["seconds"] < 1.5
        if self._kind == "second fly" and "has this vehicle" not in row["second"]:
            return False
        seconds = math.inf if row["seconds"] is None else row["seconds"]
        in_time = not ends_flight(self._kind) or seconds <= ENDING
        return in_time and not row["fell"] and not row["hard"]


def _lives(pid) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except OSError:
        return False
