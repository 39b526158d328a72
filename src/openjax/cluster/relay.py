"""The one port at which the other processes of a job reach process 0; a process beside it, which outlives it.

JAX ends a process at once, by a stack trace, when its connection to the coordinator in process 0 closes. Passed through
here such a connection stays open when process 0 dies, and the process has time to say in one line what happened. The
processes' own connections, which begin with a line of JSON, close as usual; by that the loss is noticed.

Needs nothing but Python:  python relay.py PORT COORDINATOR_PORT OWN_PORT
"""

import asyncio
import contextlib
import os
import signal
import sys

LINGER = 60.0
"""Seconds for which the others' connections stay open after process 0 has gone."""


async def relay(port: int, coordinator_port: int, own_port: int) -> None:
    """Pass connections from `port` on to this host's loopback, until standard input ends and they close."""
    connections: set[asyncio.Task] = set()

    async def serve(reader, writer):
        connections.add(asyncio.current_task())
        with contextlib.suppress(OSError, asyncio.IncompleteReadError):  # refused: the caller tries again
            first = await reader.readexactly(1)
            own = first == b"{"
            there = await asyncio.open_connection("127.0.0.1", own_port if own else coordinator_port)
            there[1].write(first)
            back = asyncio.create_task(_pump(there[0], writer, tell_end=own))
            await _pump(reader, there[1], tell_end=True)
            await back
            there[1].close()
        writer.close()

    server = await asyncio.start_server(serve, port=port)
    print("ready", flush=True)
    await asyncio.to_thread(sys.stdin.buffer.read)  # process 0 has closed it, or is gone
    server.close()
    if connections:
        await asyncio.wait(connections, timeout=LINGER)
    os._exit(0)


async def _pump(reader, writer, tell_end):
    """Copy until the source ends; a broken sink doesn't stop the reading."""
    with contextlib.suppress(OSError):
        while data := await reader.read(1 << 16):
            with contextlib.suppress(OSError):
                writer.write(data)
                await writer.drain()
    if tell_end:
        with contextlib.suppress(OSError):
            writer.write_eof()


if __name__ == "__main__":
    for number in (signal.SIGINT, signal.SIGTERM):  # it goes when process 0 has gone
        signal.signal(number, signal.SIG_IGN)
    try:
        asyncio.run(relay(*map(int, sys.argv[1:])))
    except OSError as error:
        sys.exit(str(error.strerror or error))
