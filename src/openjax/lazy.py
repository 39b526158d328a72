"""Packages whose names are loaded when first asked for: `openjax.learning.archive`
alone needn't wait for MuJoCo.
"""

import importlib
from collections.abc import Callable, Mapping
from typing import Any


def lazy_names(
    package: str, names: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package.

    Args:
      package: its name.
      names: the public names that live in each of its modules, as words.
    """
    homes = {name: module for module, words in names.items() for name in words.split()}

    def get(name: str):
        if name in homes:
            return getattr(importlib.import_module(f"{package}.{homes[name]}"), name)
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    return get, lambda: sorted(homes), sorted(homes)
