"""The vehicle that a URI means, however written, and a lock so that nobody else commands it."""

import contextlib
import re
import socket
from collections.abc import Iterator, Sequence
from typing import NamedTuple
from urllib.parse import urlsplit

from openjax.errors import UserError

UDP_PORT = 19850
"""The first that `cflib` scans, and what a URI without one means."""
CHANNEL = 2
RATE = "2M"
ADDRESS = "E7E7E7E7E7"
"""What `cflib` takes where a radio's URI ends early (`cflib.crtp.radiodriver`)."""
RATES = ("250K", "1M", RATE)


class Endpoint(NamedTuple):
    """A vehicle as it is reached."""

    uri: str
    """As `cflib` wants it written."""
    name: str
    """The same for all URIs that reach this vehicle."""


def endpoint_of(uri: str) -> Endpoint:
    """The vehicle that a URI means. Raises UserError for none."""
    error = UserError(
        f"--uri {uri}: expected udp://HOST:PORT or radio://0/80/2M/E7E7E7E7E7 (dongle, channel 0 "
        "to 125, rate, address)"
    )
    try:
        parts = urlsplit(uri.strip())
        kinds = {"udp": _udp, "radio": _radio}
        return kinds[parts.scheme](parts)
    except (KeyError, ValueError, UnicodeError):
        raise error from None


def _udp(parts) -> Endpoint:
    host = parts.hostname
    port = parts.port if parts.port is not None else UDP_PORT
    if not host or port == 0 or parts.path.strip("/"):
        raise ValueError
    return Endpoint(f"udp://{host}:{port}", f"udp {_address(host)}:{port}")


def _address(host: str) -> str:
    """A host's IPv4 address, as `cflib` speaks no other; all addresses of this machine
    are one. The name itself where nobody knows it.
    """
    try:
        address = socket.gethostbyname(host)
    except OSError:
        return host
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as trial:
        try:
            trial.bind((address, 0))  # only a machine's own addresses can be bound
        except OSError:
            return address
    return "here"


def _radio(parts) -> Endpoint:
    """The dongle is no part of the name: two dongles reach the same vehicle."""
    path_parts = parts.path.strip("/").split("/")
    channel, rate, address = (*path_parts, "", "", "")[:3]  # any of them may be left out
    number = int(channel) if channel else CHANNEL
    rate = rate.upper() or RATE
    address = (address or ADDRESS).upper().rjust(10, "0")
    is_radio = rate in RATES and 0 <= number <= 125 and re.fullmatch("[0-9A-F]{10}", address)
    if not parts.netloc or not is_radio:
        raise ValueError
    vehicle = f"{number}/{rate}/{address}"
    query = f"?{parts.query}" if parts.query else ""
    return Endpoint(f"radio://{parts.netloc}/{vehicle}{query}", f"radio {vehicle}")


def endpoints_of(uris: Sequence[str]) -> list[Endpoint]:
    """The vehicles of these URIs. Raises UserError for what is no URI, and for a
    vehicle that is named twice.
    """
    endpoints = [endpoint_of(uri) for uri in uris]
    first: dict[str, str] = {}
    for uri, endpoint in zip(uris, endpoints, strict=True):
        if endpoint.name in first:
            raise UserError(
                f"--uri names a vehicle twice: {first[endpoint.name]} and {uri} are the same"
            )
        first[endpoint.name] = uri
    return endpoints


@contextlib.contextmanager
def sole_command(uris: Sequence[str]) -> Iterator[None]:
    """Hold the vehicles against another `fly` on this machine, until this process ends.
    UserError: one has them.

    A name in Linux's abstract namespace ends with its process; elsewhere only the
    vehicles' own word protects them.
    """
    with contextlib.ExitStack() as stack:
        for uri, endpoint in zip(uris, endpoints_of(uris), strict=True):
            name = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
            try:
                name.bind(f"\0openjax.fly {endpoint.name}")
            except OSError as error:
                if error.errno is not None and "in use" in (error.strerror or ""):
                    raise UserError(
                        f"{uri}: another openjax.fly has this vehicle; end it first"
                    ) from None
        yield
