"""Tracing: once per machine, too. What JAX traced and lowered of a program is kept
beside the compiled programs.
"""

import hashlib
import importlib.metadata
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
from jax import export

from openjax.files import read_checked, write_checked
from openjax.vehicle.parameters import assets_directory

_KERNELS = ("__gpu$xla.gpu.triton", "triton_kernel_call", "triton_kernel_call_ffi")
"""Calls whose text JAX doesn't promise to read in other versions; kept programs are
read by the same version only.
"""
_LIBRARIES = ("jax", "jaxlib", "flax", "optax", "mujoco")


def recall(
    name: str,
    function: Callable,
    arguments: Callable[[], Sequence[Any]],
    carry: Any,
    made_from: str,
    folder: Path,
) -> Callable:
    """A function for `jax.jit` that does what `function` does, without tracing it where
    an earlier process has.

    What is kept is found again by all that it can depend on: the package's sources,
    `made_from`, the carry's kind, the devices, JAX's settings and the libraries'
    versions. It's read only whole, and holds no code but the program's.

    Args:
      name: of the program.
      function: from `jax.jit`; of its results, what isn't of the carry's type is of
      tuples, dictionaries and arrays.
      arguments: gives arrays, or `jax.ShapeDtypeStruct`s in their place; asked where
      `function` is traced.
      carry: its type and structure are those of every such part of the results.
      made_from: what `function` and its arguments' kinds were made from, beside the
      package's sources.
      folder: where programs are kept.

    Returns:
      the function; `function` itself where it can't be kept.
    """
    file = folder / f"{name}-{_key(name, carry, made_from)}.traced"
    program = _read(file)
    if program is None:
        try:
            write_checked(file, bytes(_export(function, arguments(), type(carry)).serialize()))
        except (ValueError, NotImplementedError, ImportError, OSError):
            # a call that can't be kept, a full disk
            return function
        program = _read(file)  # also now, so that it's the same program the first time
        if program is None:
            return function
    structure = jax.tree.structure(carry)

    def call(*arguments):
        results = program.call(*jax.tree.leaves(arguments))
        return _replace(results, list, lambda part: jax.tree.unflatten(structure, part))

    call.__name__ = name
    return call


def _export(function, arguments, kind):
    """The program of `function`, a function of its arguments' leaves; of a carry in its
    results the leaves, as a list.
    """
    structure = jax.tree.structure(tuple(arguments))

    def of_leaves(*leaves):
        results = function(*jax.tree.unflatten(structure, leaves))
        return _replace(results, kind, jax.tree.leaves)

    leaves = [
        jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(tuple(arguments))
    ]
    checks = [export.DisabledSafetyCheck.custom_call(name) for name in _KERNELS]
    return export.export(jax.jit(of_leaves), disabled_checks=checks)(*leaves)


def _replace(tree, kind, change):
    """The tree with every part of a kind changed."""

    def is_one(part):
        return isinstance(part, kind)

    return jax.tree.map(lambda part: change(part) if is_one(part) else part, tree, is_leaf=is_one)


def _read(file):
    """The program in a file; None where there is none, or none that is whole."""
    text = read_checked(file)
    return None if text is None else export.deserialize(bytearray(text))


def _key(name, carry, made_from):
    """A short key of everything that a program depends on."""
    # all sources: which of them a program depends on, nobody knows without tracing it
    digest = hashlib.sha256()
    sources = [*Path(__file__).parents[1].rglob("*.py"), *assets_directory().iterdir()]
    for path in sorted(path for path in sources if path.is_file()):
        digest.update(path.name.encode() + path.read_bytes())
    kinds = [(leaf.shape, str(leaf.dtype)) for leaf in jax.tree.leaves(carry)]
    # where programs are cached changes none of them
    options = {
        name: value for name, value in sorted(jax.config.values.items()) if "cache" not in name
    }
    versions = [importlib.metadata.version(library) for library in _LIBRARIES]
    devices = [(device.platform, device.device_kind) for device in jax.devices()]
    parts = (name, made_from, kinds, str(jax.tree.structure(carry)), options, versions, devices)
    digest.update(repr(parts).encode())
    return digest.hexdigest()[:32]
