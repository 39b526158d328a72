"""The directory of one run: what lies where, and that no run is overwritten by
accident.

settings.json      everything that determines the run; a policy or checkpoint needs nothing else
vehicle.toml, effects.toml, evader.npz   copies of what it flew with and against, if not the nominal
metrics.jsonl, tensorboard/  the logs
checkpoints/       whole training states: the last ones and the best by the validation tasks
policy_start.npz, policy.npz  the policy before training and the best one
layouts.json       before and after, per layout
training.png, trajectories.png, chase.gif
not_finite/        only after a NaN: the state that holds it
run.lock           held by the process that trains here
"""

import contextlib
import dataclasses
import fcntl
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from openjax.errors import UserError
from openjax.files import (
    WRITING,
    check_output_folder,
    read_json,
    read_toml,
    remove_unfinished,
    to_plain,
    write_json,
)
from openjax.learning import TrainSettings
from openjax.plain import from_plain

_FORMAT = "openjax run 1"
SETTINGS_FILE = "settings.json"
VEHICLE_FILE = "vehicle.toml"
EFFECTS_FILE = "effects.toml"
EVADER_FILE = "evader.npz"
_FILES = (
    SETTINGS_FILE,
    VEHICLE_FILE,
    EFFECTS_FILE,
    EVADER_FILE,
    "metrics.jsonl",
    "policy_start.npz",
    "policy.npz",
    "layouts.json",
    "training.png",
    "trajectories.png",
    "chase.gif",
)
_FOLDERS = ("checkpoints", "tensorboard", "not_finite")
_LOCK = "run.lock"


@dataclasses.dataclass(frozen=True)
class RunDirectory:
    """Paths of one run."""

    path: Path

    @property
    def checkpoints(self) -> Path:
        """Folder of the training states; see `openjax.store.checkpoints`."""
        return self.path / "checkpoints"

    @property
    def settings_file(self) -> Path:
        """The settings that determine the run, as JSON; a folder that has it is a run."""
        return self.path / SETTINGS_FILE

    @property
    def start_policy(self) -> Path:
        """The policy before training."""
        return self.path / "policy_start.npz"

    @property
    def policy(self) -> Path:
        """The best policy, once training has ended."""
        return self.path / "policy.npz"

    def optional(self, name: str) -> Path | None:
        """A file of the run if it's there: of the vehicle, the effects or the evader."""
        path = self.path / name
        return path if path.exists() else None

    def write_settings(self, settings: Any, facts: dict) -> None:
        """Record the settings (nested dataclass) and facts like machine and command
        line.
        """
        write_json(self.settings_file, {"format": _FORMAT, "settings": settings, **facts})

    def read_facts(self) -> dict:
        """The facts that `write_settings` was given beside the settings."""
        return read_json(self.settings_file)

    def read_settings(self) -> TrainSettings:
        """The settings of the run.

        Raises:
          UserError: not written by openjax, or with settings that this version doesn't
          know.
        """
        content = read_json(self.settings_file)
        if not isinstance(content, dict) or content.get("format") != _FORMAT:
            raise UserError(f"{self.settings_file} isn't of the format {_FORMAT!r}")
        return from_plain(TrainSettings, content.get("settings"), f"{self.settings_file}: ")


def read_config(path: Path, default: TrainSettings) -> TrainSettings:
    """Settings with what a file changes: a TOML or JSON file of them, or a run's own.

    Raises:
      UserError: no such file, or settings that there aren't.
    """
    if path.suffix == ".toml":
        changes = read_toml(path, "settings file")
    else:
        changes = read_json(path)
        if isinstance(changes, dict) and changes.get("format") == _FORMAT:
            changes = changes.get("settings")
    if not isinstance(changes, dict):
        raise UserError(f"{path} holds no settings by name")
    return from_plain(TrainSettings, _merge(to_plain(default), changes), f"{path}: ")


def _merge(settings, changes):
    """Plain settings with others in their place, group by group."""
    both = dict(settings)
    for name, value in changes.items():
        is_group = isinstance(value, dict) and isinstance(both.get(name), dict)
        both[name] = _merge(both[name], value) if is_group else value
    return both


def is_run(path: Path) -> bool:
    """True if the directory holds a run."""
    return (Path(path) / SETTINGS_FILE).is_file()


def open_run(path: Path) -> RunDirectory:
    """A run that exists.

    Raises:
      UserError: there is none.
    """
    if not is_run(path):
        raise UserError(
            f"{path} is no run; expected a directory written by openjax.train (with "
            f"{SETTINGS_FILE})"
        )
    return RunDirectory(Path(path))


def check_free(path: Path, overwrite: bool) -> None:
    """Raise UserError unless a new run may be written to `path`; changes nothing.

    What a run left that was killed before it had settings is in nobody's way.

    Raises:
      UserError: it holds a run and `overwrite` is False, or it holds other things, or
      can't be written to.
    """
    path = Path(path)
    if path.exists() and not path.is_dir():
        raise UserError(f"{path} is a file; --out takes a directory")
    check_output_folder(path, "--out")
    if is_run(path):
        if not overwrite:
            raise UserError(
                f"{path} already holds a run; --resume {path} goes on with it, --overwrite "
                "replaces it"
            )
    elif path.is_dir() and any(not _is_ours(entry.name) for entry in path.iterdir()):
        raise UserError(f"{path} holds files that aren't a run's; choose another --out")


def create_run(path: Path, overwrite: bool) -> RunDirectory:
    """An empty run directory; with `overwrite` a run that is there is removed, and only
    its own files.

    Call it inside `lock_run`.
    """
    check_free(path, overwrite)
    path = Path(path)
    path.mkdir(parents=True, exist_ok=True)
    # the settings file goes first: what is left of a half-removed run is no run that
    # could be resumed
    for name in _FILES:
        (path / name).unlink(missing_ok=True)
    for name in _FOLDERS:
        shutil.rmtree(path / name, ignore_errors=True)
    remove_unfinished(path)
    return RunDirectory(path)


@contextlib.contextmanager
def lock_run(path: Path) -> Iterator[None]:
    """Keep the directory, which is made where it isn't there, for this process; its end
    gives it free, also a kill.

    Raises:
      UserError: another process trains there.
    """
    path = Path(path)
    path.mkdir(parents=True, exist_ok=True)
    # the file stays: a process that opens it while another one removes it would hold
    # nothing
    with open(path / _LOCK, "a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UserError(
                f"another process trains in {path}; wait for it, or choose another --out"
            ) from None
        except OSError:  # a file system without locks
            pass
        yield


def _is_ours(name):
    """True if a run writes something of this name, or left it unfinished."""
    return name in (*_FILES, *_FOLDERS, _LOCK) or name.startswith(WRITING)
