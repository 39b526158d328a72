"""Files that people hand in, read strictly; files that openjax writes, whole or not at
all.
"""

import contextlib
import dataclasses
import errno
import hashlib
import json
import os
import shutil
import tempfile
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

from openjax.errors import UserError
from openjax.interruption import undivided, unfinished

LARGEST_TEXT = 16 * 2**20
"""Bytes of the largest TOML or JSON file that is read."""

DEEPEST = 32
"""Levels of nesting in a TOML or JSON file."""

WRITING = ".writing-"
"""What the names of unfinished files begin with; only a process that was killed
(SIGKILL) leaves one behind.
"""


def read_toml(path: str | Path, what: str = "file") -> dict[str, Any]:
    """The tables of a TOML file that a person may have written.

    Args:
      path: the file.
      what: names it in errors, for example `effects file`.

    Raises:
      UserError: it's missing, too large, no TOML or nested too deep, or holds integers
      of more than 64 bits.
    """
    return _read(path, what, "TOML", tomllib.loads)


def read_json(path: str | Path, what: str = "file") -> Any:
    """The value in a JSON file, as strictly as `read_toml`."""
    return _read(path, what, "JSON", json.loads)


def _read(path, what, language, parse: Callable[[str], Any]):
    path = Path(path)
    try:
        if not path.exists():
            raise UserError(f"{path}: no such {what}")
        if not path.is_file():
            raise UserError(f"{path}: isn't a file; the {what} is one{_example(path, language)}")
        if path.stat().st_size > LARGEST_TEXT:
            raise UserError(f"{path}: {path.stat().st_size} bytes are too many for a {what}")
        # editors of Windows begin with a mark
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise UserError(
            f"{path}: not readable as {language} (byte {error.start} is not UTF-8)"
        ) from None
    except (OSError, ValueError) as error:
        raise UserError(
            f"{path}: can't be read ({getattr(error, 'strerror', None) or error})"
        ) from None
    try:
        value = parse(text)
    except RecursionError:
        raise UserError(f"{path}: nested more than {DEEPEST} levels deep") from None
    except ValueError as error:
        raise UserError(f"{path}: not readable as {language} ({error})") from None
    _check_plain(path, value)
    return value


def _example(folder: Path, language: str) -> str:
    """Examples of the files of a language that a folder holds, in words."""
    names = sorted(file.name for file in folder.glob(f"*.{language.lower()}"))
    return f", such as {', '.join(names[:2])} in there" if names else ""


def _check_plain(path, value):
    """Raises UserError for nesting and integers that nothing here can mean."""
    # level by level and not by recursion, which a hostile file could exhaust
    level = [value]
    for _ in range(DEEPEST):
        inner = []
        for entry in level:
            if isinstance(entry, dict):
                inner += entry.values()
            elif isinstance(entry, list):
                inner += entry
            elif isinstance(entry, int) and not -(2**63) <= entry < 2**64:
                raise UserError(f"{path}: holds an integer of more than 64 bits")
        if not inner:
            return
        level = inner
    raise UserError(f"{path}: nested more than {DEEPEST} levels deep")


@contextlib.contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """A path to write a file or folder to; it takes the place of `path` when the block
    ends without an error.

    Readers see what was there before or the whole of the new, also after a power
    failure; after an error nothing of the new is left. Whatever the disk or the
    permissions have against it is an `OSError`.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # the suffix stays the last, since some writers choose their format by it
    partial = path.with_name(f"{WRITING}{os.getpid()}-{path.name}")
    with unfinished(partial):
        try:
            yield partial
            _put_in_place(partial, path)
        except BaseException:
            with contextlib.suppress(OSError):
                shutil.rmtree(partial) if partial.is_dir() else partial.unlink(missing_ok=True)
            raise


def _put_in_place(partial: Path, path: Path) -> None:
    """Rename what was written to where it belongs, once it is on the disk."""
    for file in (partial, *partial.rglob("*")) if partial.is_dir() else (partial,):
        flush(file)
    folder_there = path.is_dir() and not path.is_symlink()
    if folder_there and not partial.is_dir():
        raise IsADirectoryError(21, "is a folder", str(path))
    with undivided():  # else neither the old folder nor the new one might be left
        if folder_there:
            shutil.rmtree(path)
        os.replace(partial, path)
    flush(path.parent)


@contextlib.contextmanager
def claim(path: Path, option: str) -> Iterator[None]:
    """Keep `path` for this process while the block runs; its folder is made and, where
    nothing was written, goes again. Raises UserError where another process has it.
    """
    is_new = not path.parent.exists()
    with _write_errors(option, path):
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = path.with_name(f"{WRITING}{path.name}.lock")
        file = lock.open("w")
    try:
        with unfinished(lock), file:
            try:
                _lock(file)
            except OSError:
                raise UserError(
                    f"{option} {path}: another process is writing there; wait for it, or name "
                    "another folder"
                ) from None
            try:
                yield
            finally:
                lock.unlink(missing_ok=True)
    finally:
        if is_new:
            with contextlib.suppress(OSError):
                path.parent.rmdir()


def _lock(file: IO) -> None:
    """Lock an open file until it is closed or its process ends, however it ends. Raises
    OSError where another process has it.
    """
    if os.name == "nt":
        import msvcrt

        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def flush(path: Path) -> None:
    """Wait until a file's content, or a folder's names, are on the disk."""
    if path.is_dir() and os.name == "nt":  # folders can't be opened there
        return
    descriptor = os.open(path, os.O_RDONLY if os.name != "nt" else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_checked(path: str | Path, content: bytes) -> None:
    """Write a file in one piece, its SHA-256 before its content; for `read_checked`."""
    with replacing(path) as partial:
        partial.write_bytes(hashlib.sha256(content).digest() + content)


def read_checked(path: str | Path) -> bytes | None:
    """The content of a file of `write_checked`; None where there is none, or it isn't
    whole.
    """
    try:
        data = Path(path).read_bytes()
    except OSError:
        return None
    size = hashlib.sha256().digest_size
    digest = data[:size]
    content = data[size:]
    return content if hashlib.sha256(content).digest() == digest else None


def write_text(path: str | Path, text: str) -> None:
    """Write a UTF-8 file in one piece."""
    with replacing(path) as partial:
        partial.write_text(text, encoding="utf-8")


def to_plain(value: Any) -> Any:
    """Dataclasses, tuples and paths as JSON values (dict, list, str, numbers, None)."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {
            field.name: to_plain(getattr(value, field.name)) for field in dataclasses.fields(value)
        }
    if isinstance(value, dict):
        return {str(key): to_plain(entry) for key, entry in value.items()}
    if isinstance(value, tuple | list):
        return [to_plain(entry) for entry in value]
    if isinstance(value, Path):
        return str(value)
    # a number of NumPy's or JAX's
    if hasattr(value, "item") and getattr(value, "ndim", 0) == 0:
        return value.item()
    return value


def write_json(path: str | Path, value: Any) -> None:
    """Write settings and results (see `to_plain`; no NaN) as JSON, in one piece."""
    write_text(path, json.dumps(to_plain(value), indent=2, allow_nan=False) + "\n")


def check_output(path: str | Path | None, option: str) -> None:
    """Raise UserError unless a file can be written later, before the work that leads to it; None is
    fine.

    Raises:
      UserError: its folder is missing or can't be written to, or it's a folder itself.
    """
    if path is None:
        return
    path = Path(path).absolute()
    with _write_errors(option, path):
        if path.is_dir():
            raise UserError(f"{option} {path}: is a folder; a file is needed")
        if not path.parent.is_dir():
            raise UserError(f"{option} {path}: the folder {path.parent} doesn't exist")
        # tried and not asked: permissions don't tell of a full or a read-only disk
        with tempfile.TemporaryFile(dir=path.parent):
            pass
        if path.exists() and not os.access(path, os.W_OK):
            raise UserError(f"{option} {path}: you may not write there")


@contextlib.contextmanager
def _write_errors(option, path):
    """The system's message about a place that can't be written to, as a line."""
    try:
        yield
    except OSError as error:
        raise UserError(
            f"{option} {path}: can't be written there ({error.strerror or error})"
        ) from None


def check_output_folder(path: str | Path, option: str) -> None:
    """Raise UserError unless a folder is there or can be made, and can be written to; changes
    nothing.
    """
    path = Path(path).absolute()
    with _write_errors(option, path):
        # the nearest folder above that is there already
        parent = next(folder for folder in (path, *path.parents) if folder.exists())
        if not parent.is_dir():
            which = "it" if parent == path else parent
            raise UserError(f"{option} {path}: {which} is a file; a folder is needed")
        with tempfile.TemporaryFile(dir=parent):
            pass


def check_room(path: str | Path, size: int, option: str) -> None:
    """Raise UserError unless so many bytes can be written in a folder that is there or can be made;
    leaves nothing.
    """
    path = Path(path).absolute()
    parent = next(folder for folder in (path, *path.parents) if folder.is_dir())
    free = shutil.disk_usage(parent).free
    if free < size:
        raise UserError(
            f"{option} {path}: only {free / 1e6:.0f} MB are free; {size / 1e6:.0f} MB are needed"
        )
    if not hasattr(os, "posix_fallocate"):
        return
    # taken and given back: free space doesn't tell of a user's limits
    with _write_errors(option, path), tempfile.TemporaryFile(dir=parent) as file:
        try:
            os.posix_fallocate(file.fileno(), 0, size)
        except OSError as error:
            if error.errno in (errno.ENOSPC, errno.EFBIG, errno.EDQUOT):
                raise OSError(error.errno, f"no room for {size / 1e6:.0f} MB") from None


def check_new_folder(path: str | Path, option: str) -> None:
    """Raise UserError unless a folder can be made there, or is there and empty; changes nothing."""
    path = Path(path)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise UserError(f"{option} {path}: exists and isn't an empty folder; name another one")
    check_output_folder(path, option)


def remove_unfinished(folder: Path) -> None:
    """Delete what killed processes left of files they were writing."""
    for path in folder.glob(f"{WRITING}*"):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
