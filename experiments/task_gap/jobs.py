"""The pieces of work: a case's flights and their diagnosis, and chunks of episodes in one world."""

import dataclasses
import json
import time
from pathlib import Path

from experiments.task_gap.flights import Case, diagnose_flights, write_flights

CONDITIONS = {
    "clamp, drawn starts": {"speed_limit": "clamp", "start_attitude": "drawn"},
    "clamp, level starts": {"speed_limit": "clamp", "start_attitude": "level"},
    "no clamp, drawn starts": {"speed_limit": "none", "start_attitude": "drawn"},
}


@dataclasses.dataclass(frozen=True)
class Job:
    """One piece of work: the flights of a case, or a chunk of episodes in one world. Its result is a JSON file."""

    world: str  # flights, nominal, plant, corrected
    case: Case | None
    work: Path
    policy: str
    condition: str
    start: int
    number: int
    deadline: float
    substeps: int = 1  # of the simulators; the plant has its own

    @property
    def path(self) -> Path:
        """Where the result is kept."""
        if self.world == "flights":
            return self.work / "flights" / f"{self.case.name}.json"
        name = world_name(self.world, self.case, self.substeps)
        return (
            world_folder(self.work, self.policy, self.condition) / f"{name}_{self.start}_{self.number}.json"
        )


def world_folder(work: Path, policy: str, condition: str) -> Path:
    """Where the episodes of a policy under a condition are kept."""
    return work / Path(policy).stem / condition.replace(", ", "_").replace(" ", "_")


def world_name(world: str, case: Case | None, substeps: int) -> str:
    """By which the files of a world are called."""
    name = f"{case.name}_{world}" if case else world
    return name if world == "plant" else f"{name}_{substeps}"


def do(job: Job) -> tuple[str, float]:
    """Do a job unless its result is there already or time is up; returns what was done and the seconds."""
    if job.path.exists() or time.time() > job.deadline:
        return "", 0.0
    begin = time.perf_counter()
    if job.world == "flights":
        folder = job.work / "cases" / job.case.name
        said = write_flights(job.case, folder)
        result = {"flown": said, "found": diagnose_flights(folder)}
    else:
        result = _fly(job)
    job.path.parent.mkdir(parents=True, exist_ok=True)
    partial = job.path.with_suffix(".partial")
    partial.write_text(json.dumps(result))
    partial.replace(job.path)
    return str(job.path.relative_to(job.work)), time.perf_counter() - begin


def _fly(job):
    from experiments.task_gap.flights import corrected_effects
    from experiments.task_gap.game import fly_plant, fly_simulator
    from openjax.store.policies import load_policy

    loaded = load_policy(job.policy)
    settings = dataclasses.replace(loaded.settings.environment, **CONDITIONS[job.condition])
    if job.world != "plant":
        settings = dataclasses.replace(settings, substeps=job.substeps)
    part = (loaded, settings, job.start, job.number)
    if job.world == "nominal":
        return fly_simulator(*part)
    told = read_flights(job.work, job.case)
    if job.world == "plant":
        if job.case.cause is not None:
            job.case.cause["size"] = told["flown"]["size"]
        return fly_plant(*part, job.case)
    folder = job.work / "cases" / job.case.name
    return fly_simulator(*part, *corrected_effects(folder, told["found"]["voltage"]))


def read_flights(work: Path, case: Case) -> dict:
    """What the flights of a case were and what was found in them."""
    return json.loads((work / "flights" / f"{case.name}.json").read_text())
