"""Trained policies as one small file: arrays and settings in a .npz, no pickle.

A file holds the leaves of a parameter tree under their paths, the settings that rebuild everything around
them, and a note of where they come from. Floating-point arrays are stored as float16 by default (half the
size, about three decimal digits), other kinds stay as they are.
"""

import json
import zipfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from openjax.errors import UserError
from openjax.store.checkpoints import named_leaves
from openjax.store.settings_files import to_plain

_FORMAT = "openjax policy 1"
_HEADER = "openjax.json"
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
    header = {"format": _FORMAT, "settings": to_plain(settings), "notes": to_plain(notes or {}), "dtypes": {}}
    arrays = {}
    for name, leaf in named_leaves(parameters).items():
        array = np.asarray(leaf.astype(jnp.float32) if leaf.dtype == jnp.bfloat16 else leaf)
        header["dtypes"][name] = str(leaf.dtype)
        arrays[name] = array.astype(storage) if np.issubdtype(array.dtype, np.floating) else array
    arrays[_HEADER] = np.frombuffer(json.dumps(header).encode(), dtype=np.uint8)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".writing.npz")
    np.savez_compressed(temporary, **arrays)
    temporary.replace(path)


def load_policy_file(path: Path) -> tuple[dict[str, np.ndarray], dict, dict]:
    """Leaves by path in their original dtype, the settings and the notes as plain values.

    Raises:
      UserError: no policy file, or one of another format.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            stored = {name: archive[name] for name in archive.files}
        header = json.loads(stored.pop(_HEADER).tobytes())
    except OSError as error:
        raise UserError(f"{path} can't be read: {error.strerror or error}") from error
    except (ValueError, KeyError, zipfile.BadZipFile, EOFError) as error:
        raise UserError(f"{path} is no policy file; expected one written by openjax.train (.npz)") from error
    if header.get("format") != _FORMAT:
        raise UserError(f"{path} has the format {header.get('format')!r}; expected {_FORMAT!r}")
    leaves = {name: array.astype(jnp.dtype(header["dtypes"][name])) for name, array in stored.items()}
    return leaves, header["settings"], header["notes"]


def fill(abstract: Any, leaves: dict[str, np.ndarray], where: str, prefix: str = "") -> Any:
    """The tree of `abstract` (shapes and dtypes) with its leaves taken by path, which starts with `prefix`.

    Raises:
      UserError: a leaf is missing or has another shape; `where` names the source.
    """
    filled = []
    for path, leaf in named_leaves(abstract).items():
        name = prefix + path
        if name not in leaves:
            raise UserError(f"{where} lacks the parameters {name}; it was made by another network or version")
        if leaves[name].shape != leaf.shape:
            raise UserError(
                f"{where} is of another shape: {name} is {list(leaves[name].shape)} there, "
                f"its settings make it {list(leaf.shape)}"
            )
        filled.append(jnp.asarray(leaves[name], leaf.dtype))
    return jax.tree.unflatten(jax.tree.structure(abstract), filled)


def shipped_policies() -> list[str]:
    """Names of the policies inside the package."""
    return sorted(path.stem for path in WEIGHTS.glob("*.npz"))
