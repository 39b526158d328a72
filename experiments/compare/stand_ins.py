"""Empty modules in place of packages that the libraries import but that take no part in what is timed.

crazyflow imports casadi (90 MB) for its symbolic models, JaxMARL imports matplotlib for drawing. Where they are not
installed, `use_stand_ins` lets the import go through; the names of those in use go into the results.
"""

import importlib.util
import operator
import sys
from collections.abc import Iterable, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType


class _Anything:
    """Answers attributes, calls, items and arithmetic with itself, so that module-level code runs through."""

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return self

    def __call__(self, *_, **__):
        return self

    def __iter__(self):
        return iter(())


_OPERATORS = "add sub mul matmul truediv pow neg abs lt le gt ge getitem or_ and_ invert"
for _name in _OPERATORS.split():
    assert hasattr(operator, _name)
    _special = f"__{_name.strip('_')}__"
    setattr(_Anything, _special, lambda self, *_: self)
    setattr(_Anything, f"__r{_special[2:]}", lambda self, *_: self)
_Anything.__setitem__ = lambda self, key, value: None

_ANYTHING = _Anything()


class _StandIn(ModuleType):
    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return _ANYTHING


class _Finder(MetaPathFinder, Loader):
    def __init__(self, names: Iterable[str]):
        self.names = frozenset(names)

    def find_spec(self, fullname, path=None, target=None):
        if fullname.partition(".")[0] in self.names:
            return ModuleSpec(fullname, self, is_package=True)
        return None

    def create_module(self, spec):
        return _StandIn(spec.name)

    def exec_module(self, module):
        pass


def use_stand_ins(names: Sequence[str]) -> list[str]:
    """Let those of the top-level packages `names` that aren't installed import as empty; returns their names."""
    missing = [name for name in names if name not in sys.modules and importlib.util.find_spec(name) is None]
    if missing:
        sys.meta_path.append(_Finder(missing))
    return missing
