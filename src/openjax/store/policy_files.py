"""Trained policies as one small file: arrays and settings in a .npz, no pickle.

A file holds the leaves of a parameter tree under their paths, the settings that rebuild
everything around them, and a note of where they come from. Floating-point arrays are
stored as float16 by default (half the size, about three decimal digits), other kinds
stay as they are.
"""

import hashlib
import json
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from openjax.errors import UserError
from openjax.files import replacing, to_plain
from openjax.store.leaves import named_leaves

_FORMAT = "openjax policy 1"
_HEADER = "openjax.json"
LARGEST = 512 * 2**20
"""Bytes of the arrays of a policy file that is read."""

WEIGHTS = Path(__file__).resolve().parents[1] / "weights"


def save_policy_file(
    path: Path, parameters: Any, settings: Any, notes: dict | None = None, storage: str = "float16"
) -> None:
    """Write a policy.

    Args:
      path: the file, ending in .npz.
      parameters: pytree of arrays.
      settings: nested dataclass that `load_policy_file` hands back as plain values.
      notes: anything worth knowing later (commit, steps, scores).
      storage: dtype in which floating-point arrays are stored: `float16` or `float32`.
    """
    header = {
        "format": _FORMAT,
        "settings": to_plain(settings),
        "notes": to_plain(notes or {}),
        # as they were: in the file most are shorter
        "dtypes": {},
    }
    arrays = {}
    for name, leaf in named_leaves(parameters).items():
        # NumPy's files know no bfloat16
        array = np.asarray(leaf.astype(jnp.float32) if leaf.dtype == jnp.bfloat16 else leaf)
        header["dtypes"][name] = str(leaf.dtype)
        arrays[name] = array.astype(storage) if np.issubdtype(array.dtype, np.floating) else array
    header["digest"] = _digest(arrays)
    arrays[_HEADER] = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    with replacing(path) as partial:
        np.savez_compressed(partial, **arrays)


def load_policy_file(
    path: Path, kind: str = "policy file", writer: str = "openjax.train"
) -> tuple[dict[str, np.ndarray], dict, dict]:
    """Leaves by path in their original dtype, the settings and the notes as plain
    values; `kind` and `writer` for errors.

    Raises:
      UserError: no policy file, or one of another format.
    """
    try:
        arrays = _read_arrays(Path(path))
        header = json.loads(arrays.pop(_HEADER).tobytes())
        if not isinstance(header, dict) or header.get("format") != _FORMAT:
            raise UserError(f"{path} isn't of the format {_FORMAT!r}")
        # older files have none
        if header.get("digest", _digest(arrays)) != _digest(arrays):
            raise UserError(
                f"{path}: its arrays aren't those that {writer} wrote; take the file as it was"
            )
        leaves = {
            name: array.astype(_dtype(header["dtypes"][name])) for name, array in arrays.items()
        }
        settings = header["settings"]
        notes = header["notes"]
    except UserError:
        raise
    except OSError as error:
        raise UserError(f"{path} can't be read: {error.strerror or error}") from error
    except Exception as error:
        # a damaged or foreign archive fails in every way that zipfile and NumPy know
        raise UserError(
            f"{path} is no {kind}, or it's damaged ({type(error).__name__}); expected one written "
            f"by {writer} (.npz)"
        ) from error
    # float16 turns what is larger than 65,504 into infinity, and a flipped bit may do
    # it, too
    unequal = [
        name for name, leaf in leaves.items() if not np.isfinite(leaf.astype(np.float32)).all()
    ]
    if unequal:
        raise UserError(f"{path} holds numbers that aren't finite, in {unequal[0]}")
    return leaves, settings, notes


def _digest(arrays: dict[str, np.ndarray]) -> str:
    """SHA-256 of arrays with their names and shapes."""
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


def _read_arrays(path):
    """The arrays of an .npz file, without pickles, and none larger than `LARGEST`."""
    # before anything is unpacked: a small file may claim to hold more than the memory
    with zipfile.ZipFile(path) as archive:
        if sum(member.file_size for member in archive.infolist()) > LARGEST:
            raise UserError(
                f"{path} holds more than {LARGEST >> 20} MiB; no policy of openjax is so large"
            )
    with np.load(path, allow_pickle=False) as npz:
        return {name: npz[name] for name in npz.files}


def _dtype(name):
    """The type of a leaf: one that networks have."""
    dtype = jnp.dtype(name)
    if dtype.kind not in "fiub" and dtype != jnp.bfloat16:
        raise ValueError(f"type {name}")
    return dtype


def fill(abstract: Any, leaves: dict[str, np.ndarray], source: str) -> Any:
    """The tree of `abstract` (shapes and dtypes) with its leaves taken by path.

    Raises:
      UserError: a leaf is missing or has another shape; `source` names the source.
    """
    values = []
    for name, leaf in named_leaves(abstract).items():
        if name not in leaves:
            raise UserError(
                f"{source} lacks the parameters {name}; it was made by another network or version"
            )
        if leaves[name].shape != leaf.shape:
            raise UserError(
                f"{source} is of another shape: {name} is {list(leaves[name].shape)} there, "
                f"its settings make it {list(leaf.shape)}"
            )
        values.append(jnp.asarray(leaves[name], leaf.dtype))
    return jax.tree.unflatten(jax.tree.structure(abstract), values)


def shipped_policies() -> list[str]:
    """Names of the policies inside the package."""
    return sorted(path.stem for path in WEIGHTS.glob("*.npz"))
