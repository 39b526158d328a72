"""Holds the others' connections to JAX's coordinator when process 0, which runs it, dies: a process beside process 0.

JAX ends a process at once, by a stack trace, when its connection to the coordinator closes. Passed through here, such a
connection stays open, and the process has time to say in one line what happened. Needs nothing but Python.

python coordinator_relay.py PORT COORDINATOR_PORT
"""

import asyncio
import contextlib
import os
import signal
import sys

LINGER = 60.0
"""Seconds for which the others' connections stay open after process 0 has gone."""


async def relay(port: int, coordinator_port: int) -> None:
    """Pass connections from `port` on to the coordinator on this host, until standard input ends and they close."""
    connections: set[asyncio.Task] = set()

    async def serve(reader, writer):
        connections.add(asyncio.current_task())
        try:
            inner_reader, inner_writer = await asyncio.open_connection("127.0.0.1", coordinator_port)
        except OSError:  # not up yet: the caller tries again
            writer.close()
            return
        back = asyncio.create_task(_pump(inner_reader, writer))
        await _pump(reader, inner_writer)
        inner_writer.close()
        await back
        writer.close()

    server = await asyncio.start_server(serve, port=port)
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    await asyncio.to_thread(sys.stdin.buffer.read)  # process 0 has closed it, or is gone
    server.close()
    if connections:
        await asyncio.wait(connections, timeout=LINGER)
    os._exit(0)


async def _pump(reader, writer):
    """Copy until the source ends; the sink is left open, and when it's broken the source is still read."""
    with contextlib.suppress(OSError):
        while data := await reader.read(1 << 16):
            with contextlib.suppress(OSError):
                writer.write(data)
                await writer.drain()


if __name__ == "__main__":
    for number in (signal.SIGINT, signal.SIGTERM):  # it goes when process 0 has gone
        signal.signal(number, signal.SIG_IGN)
    try:
        asyncio.run(relay(int(sys.argv[1]), int(sys.argv[2])))
    except OSError as error:
        sys.exit(str(error.strerror or error))
