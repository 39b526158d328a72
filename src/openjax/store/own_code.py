"""Functions of one's own for commands, named by the file that they are written in."""

import importlib.util
from pathlib import Path
from typing import Any

from openjax.errors import UserError


def is_own_code(name: Any) -> bool:
    """True if it names something in a Python file, `FILE.py:name`."""
    return isinstance(name, str) and ".py:" in name


def own_code(option: str, name: str, kinds: tuple[type, ...], what: str) -> Any:
    """The object that `FILE.py:name` names; the file is run.

    Args:
      option: that asked for it.
      name: of file and thing.
      kinds: of which it may be, unless it can be called.
      what: it should be, in words.

    Raises:
      UserError: no such file, it doesn't run, or it has nothing of that name and kind.
    """
    file, _, attribute = name.rpartition(":")
    path = Path(file)
    if not path.is_file():
        raise UserError(f"{option} {name}: there is no file {file}")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:  # whatever the file does
        raise UserError(f"{option} {name}: {path} doesn't run: {error}") from error
    value = getattr(module, attribute, None)
    if not callable(value) and not isinstance(value, kinds):
        raise UserError(f"{option} {name}: {path} has no {what.format(attribute)}")
    return value
