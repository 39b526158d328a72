"""Errors that are meant for people."""

import difflib
from collections.abc import Iterable
from typing import Any


class UserError(Exception):
    """Something a user asked for can't be done.

    The message is one line: what was wrong, where, and what would be right. Commands
    print it and exit with status 2.
    """


class TooLittle(UserError):
    """Logs hold too little for what was asked; something less may still be possible."""


def suggestion(name: str, names: Iterable[str]) -> str:
    """The end of an error about a name that isn't among `names`: the nearest of them, or all."""
    names = list(names)
    # `drag` is short of `rotor_drag` by more than one typing error
    longer = [other for other in names if name and name in other]
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.6) or longer
    return f"did you mean {close[0]}?" if close else f"there are {', '.join(names)}"


def part_name(part: Any) -> str:
    """The name of a part in an error: that of a function or a class, or of an object's class."""
    return getattr(part, "__name__", type(part).__name__)
