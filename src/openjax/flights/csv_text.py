"""The text of a CSV log before its numbers are read: unpacked, decoded, and its header found.

Loggers and spreadsheets put things around a table: comments above the header, Excel's `sep=;`,
semicolons with decimal commas, UTF-16, a row of units, a comma at the end of each line.
"""

import gzip
import io
import re
import zlib
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

from openjax.errors import UserError

# What one log may hold: a quarter of an hour at 1 kHz is 256 MB of text and a million rows.
LARGEST = 256 << 20  # bytes of text
MOST_ROWS = 2_000_000
CHUNK = 1 << 20  # bytes that are unpacked at once
# bytes: a header of a firmware's some hundred names has 10,000
LONGEST_HEADER = 1 << 16
GZIP = b"\x1f\x8b"
ZIP = b"PK\x03\x04"  # also of spreadsheets
WIDE = (b"\xff\xfe", b"\xfe\xff")  # how a text in UTF-16 begins
WIDEST = (b"\xff\xfe\0\0", b"\0\0\xfe\xff")  # in UTF-32
SEPARATORS = (",", ";", "\t", "|")
CONTROLS = bytes(set(range(32)) - set(b"\t\n\r"))
BEYOND_ASCII = bytes(range(128, 256))
ODD = 0.05  # share of bytes beyond ASCII that a table in another code may have
COMMENT = "#"
MOST_ABOVE = 1_000  # lines among which the header is
LETTER = re.compile(r"[^\W\d_]")
NUMBERS = re.compile(r"nan|inf|\de", re.IGNORECASE)  # the letters of numbers


class LogError(UserError):
    """This log can't be used; the message says why, without the log's name."""


class Header(NamedTuple):
    """The names of a table's columns, what separates its cells, and in which of its
    lines, from 0 on, the names stand.
    """

    names: list[str]
    delimiter: str
    line: int


def text_of(path: Path) -> str:
    """A file's text with line ends of one kind. Stops unpacking at LARGEST bytes or
    MOST_ROWS lines. Raises LogError for what is no text.
    """
    chunks = []
    size = 0
    lines = 0
    try:
        with ExitStack() as stack:
            file = _open(path, stack)
            while chunk := file.read(CHUNK):
                chunks.append(chunk)
                size += len(chunk)
                lines += max(chunk.count(b"\n"), chunk.count(b"\r"))
                if size > LARGEST:
                    raise LogError(
                        f"holds more than {LARGEST >> 20} MB of text: no log of a flight; cut it "
                        "into flights"
                    )
                if lines > MOST_ROWS:
                    raise LogError(
                        f"holds more than {MOST_ROWS} lines: no log of a flight; cut it into "
                        "flights"
                    )
    except (OSError, EOFError, zlib.error) as error:
        raise LogError(f"can't be read: {error}") from error
    return _decode(b"".join(chunks))


def head_of(path: Path) -> list[str]:
    """A file's first lines; none where they can't be read as text."""
    try:
        with ExitStack() as stack:
            data = _open(path, stack).read(LONGEST_HEADER)
        return _decode(data[: len(data) // 2 * 2], cut=True).split("\n")
    except (OSError, EOFError, zlib.error, LogError):
        return []


def find_header(lines: list[str], delimiter: str = "") -> Header:
    """The header among a table's lines: the first that isn't blank and no comment.

    Args:
      lines: of the text.
      delimiter: between cells; where it is empty, what the header's line shows.

    Raises LogError where there is no text.
    """
    written_lines = [(i, line) for i, line in enumerate(lines[:MOST_ABOVE]) if line.strip()]
    if not written_lines:
        raise LogError("is empty: no column names")
    (at, line), *below = written_lines
    if len(line.strip()) == 5 and line.lower().startswith("sep=") and below:
        delimiter = delimiter or line[4]
        (at, line), *below = below
    while line.startswith(COMMENT) and below and _holds_names(below[0][1]):
        (at, line), *below = below
    line = line.removeprefix(COMMENT)  # where numpy.savetxt puts the names
    delimiter = delimiter or max(SEPARATORS, key=line.count)
    names = [name.strip().strip('"') for name in remove_quotes(line, delimiter).split(delimiter)]
    return Header(names, delimiter, at)


def _holds_names(line: str) -> bool:
    """True if a line is a comment or a header, and no row of numbers."""
    return line.startswith(COMMENT) or bool(LETTER.search(NUMBERS.sub("", line)))


def remove_quotes(line: str, delimiter: str) -> str:
    """A line without quotes around its cells, and without the delimiters that stand in them."""
    if '"' not in line:
        return line
    parts = line.split('"')
    parts[1::2] = [part.replace(delimiter, " ") for part in parts[1::2]]
    return "".join(parts) if len(parts) % 2 else line


def _open(path: Path, stack: ExitStack) -> io.BufferedIOBase:
    """A file for reading, unpacked if it is packed, whatever its name says."""
    with path.open("rb") as file:
        start = file.read(len(ZIP))
    if start == ZIP:
        raise LogError("is a zip archive or a spreadsheet: unpack it, or save it as CSV")
    is_packed = start.startswith(GZIP)
    return stack.enter_context(gzip.open(path) if is_packed else path.open("rb"))


def _is_plain(data: bytes) -> bool:
    """True if bytes are a table with a degree sign or an umlaut beside it, as
    Windows saves them.
    """
    text = data.translate(None, CONTROLS)
    odd = len(text) - len(text.translate(None, BEYOND_ASCII))
    return len(text) == len(data) and odd < ODD * len(data)


def _decode(data: bytes, cut: bool = False) -> str:
    """Bytes as text with line ends of one kind; of those that are `cut` somewhere what
    can be read. Raises LogError for what is no text.
    """
    code = "utf-8-sig"
    if data.startswith(WIDEST):
        code = "utf-32"
    elif data.startswith(WIDE):
        code = "utf-16"
    elif b"\0" in data:
        raise LogError("not a text file in UTF-8")
    try:
        text = data.decode(code)
    except UnicodeDecodeError as error:
        if code == "utf-8-sig" and error.end < len(data) and _is_plain(data):
            text = data.decode("latin-1")
        elif cut:
            text = data.decode(code, "replace")
        else:
            raise LogError("not a text file in UTF-8: save it as one") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")
