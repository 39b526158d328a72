"""The files that a run's game is made of, and which of them its directory keeps."""

import shutil
from dataclasses import dataclass
from pathlib import Path

from openjax.pursuit import Pursuit, PursuitSettings
from openjax.pursuit.evaders import Evader
from openjax.runs.train_command import TrainCommand
from openjax.store.environments import is_evader_file, make_environment
from openjax.store.run_directory import (
    EFFECTS_FILE,
    EVADER_FILE,
    VEHICLE_FILE,
    RunDirectory,
)
from openjax.vehicle.vehicle_file import copy_vehicle_file, load_vehicle_file


@dataclass(frozen=True)
class GameFiles:
    """Vehicle, effects and evader of a run's game; None where nothing was named."""

    vehicle: Path | None
    effects: Path | None
    evader: str | Path | Evader | None

    @classmethod
    def of(cls, command: TrainCommand, old_run: RunDirectory | None) -> "GameFiles":
        """Those that a command names, and where it names none, those that a resumed run kept."""

        def kept(name):
            return old_run and old_run.optional(name)

        return cls(
            command.vehicle or kept(VEHICLE_FILE),
            command.effects or kept(EFFECTS_FILE),
            command.opponent or kept(EVADER_FILE),
        )

    @property
    def are_named(self) -> bool:
        """True if there is any."""
        return any((self.vehicle, self.effects, self.evader))

    def environment(self, game: PursuitSettings) -> Pursuit:
        """The game with what they say. Raises UserError for one that can't be used."""
        return make_environment(game, self.vehicle, self.effects, self.evader)

    def copy_to(self, directory: Path) -> None:
        """Copy those that a resumed run needs. A scripted evader, or a vehicle that is known by
        name, is in its settings; a function is in no file.
        """
        if self.vehicle and load_vehicle_file(self.vehicle).path is not None:
            copy_vehicle_file(self.vehicle, directory / VEHICLE_FILE)
        if self.effects:
            shutil.copyfile(self.effects, directory / EFFECTS_FILE)
        if is_evader_file(self.evader):
            shutil.copyfile(self.evader, directory / EVADER_FILE)
