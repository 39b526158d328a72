"""Modules that are commands from a shell and functions in Python."""

import importlib
import sys
import types


class _CallableModule(types.ModuleType):
    """A module that can be called; its `CALL` names the function, imported when it is."""

    def __call__(self, *arguments, **settings):
        function = getattr(importlib.import_module("openjax.commands.calls"), self.CALL)
        return function(*arguments, **settings)


def make_callable(name: str) -> None:
    """Let `openjax.train(...)` mean `openjax.commands.calls.train(...)`, though `openjax.train` is a module."""
    sys.modules[name].__class__ = _CallableModule
