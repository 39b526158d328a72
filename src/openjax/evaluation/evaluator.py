"""Evaluation of policies on layouts and on validation tasks: episodes in batches of one
size, as records and trajectories.
"""

import dataclasses
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from openjax.background import compile_ahead, side_by_side
from openjax.evaluation.episodes import Evaluation, make_evaluate, summarise
from openjax.evaluation.message_settings import MessageSettings
from openjax.evaluation.result_tables import record_of
from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import SCENARIOS, Pursuit, PursuitSettings, Scenario, Task, scenario_task
from openjax.pursuit.statistics import EpisodeStatistics
from openjax.pursuit.task import arena_of, capture_radius
from openjax.pursuit.teams import FAR
from openjax.show.trajectory import Trajectory


class Evaluator:
    """Episodes of the mean policy, `batch` at a time: one compilation for whatever
    tasks come.

    Args:
      environment: its settings say how many pursuers and pillar slots the tasks have.
      policy: the networks.
      batch: episodes per call of the compiled function.
      messages: how well pursuers hear each other; None: perfectly.
    """

    def __init__(
        self,
        environment: Pursuit,
        policy: Policy,
        batch: int,
        messages: MessageSettings | None = None,
    ):
        self.settings = environment.settings
        self.batch = batch
        self._evaluate = jax.jit(make_evaluate(environment, policy, True, messages))

    def fly(
        self,
        parameters: PolicyParameters,
        kinds: Mapping[str, Task],
        key: jax.Array,
        tell: Callable[[str], None] = lambda name: None,
    ) -> list["Flown"]:
        """One episode per task; `kinds` are tasks by name, each with a leading axis of
        its own.

        Kinds that fill whole batches are flown each by itself (`tell` hears which), so
        that a kind's result is the same alone and among others; else all are packed into
        as few batches as they need.
        """
        numbers = [tasks.evader_position.shape[0] for tasks in kinds.values()]
        if not any(number % self.batch for number in numbers):

            def fly_kind(item):
                name, tasks = item
                tell(name)
                evaluation, records = self._fly(parameters, tasks, key)
                return Flown(self, name, tasks, evaluation, records)

            if jax.default_backend() != "cpu":
                return [fly_kind(item) for item in kinds.items()]
            # a processor flies a batch with one of its cores; both would compile it
            self.compile_ahead(parameters, next(iter(kinds.values())))()
            return side_by_side(fly_kind, kinds.items())
        one_stack, part = stack(kinds)
        evaluation, records = self._fly(parameters, one_stack, key)
        parts = part(evaluation)
        first = np.cumsum([0, *numbers])
        return [
            Flown(self, name, tasks, parts[name], records, int(first[i]))
            for i, (name, tasks) in enumerate(kinds.items())
        ]

    def _fly(self, parameters, tasks, key):
        """Evaluation (B,) of the tasks on the host, and the device trajectories of each
        batch.
        """
        number = tasks.evader_position.shape[0]
        # indexed here: on a device, each array's shape compiles another program
        tasks = jax.tree.map(np.asarray, tasks)
        evaluations = []
        records = []
        for i, start in enumerate(range(0, number, self.batch)):
            # the program knows one size: the last batch is filled up with the last task
            index = np.minimum(np.arange(start, start + self.batch), number - 1)
            part = jax.tree.map(operator.itemgetter(index), tasks)
            evaluation, record = self._evaluate(parameters, part, jax.random.fold_in(key, i))
            asked_for = slice(min(self.batch, number - start))
            evaluation = jax.tree.map(np.asarray, evaluation)
            evaluations.append(jax.tree.map(operator.itemgetter(asked_for), evaluation))
            # stays on the device: of most episodes nobody draws anything
            records.append(record)
        return jax.tree.map(lambda *parts: np.concatenate(parts), *evaluations), records

    def compile_ahead(self, parameters: PolicyParameters, task: Task) -> Callable[[], None]:
        """Start to compile for parameters and tasks of these shapes, of which `task`
        has a leading axis of any length.
        """

        def one_batch(leaf):
            return jax.ShapeDtypeStruct((self.batch, *leaf.shape[1:]), leaf.dtype)

        key = jax.random.fold_in(jax.random.key(0), 0)
        return compile_ahead(self._evaluate, parameters, jax.tree.map(one_batch, task), key)


@dataclasses.dataclass(frozen=True)
class Flown:
    """Episodes of one kind of tasks."""

    evaluator: Evaluator
    name: str
    tasks: Task  # (B, ...)
    evaluation: Evaluation  # (B,), on the host
    records: list[Any]
    """Device trajectories by batch ..."""
    first: int = 0
    """... of which this many are of other kinds."""

    def record(self, extra: tuple[str, ...] = ()) -> dict:
        """Means over the episodes; see `record_of`."""
        number = self.tasks.evader_position.shape[0]
        return record_of(self.name, number, summarise(self.evaluation), extra)

    def trajectory(self, episode: int, title: str) -> Trajectory:
        """One of the episodes, for drawing."""
        batch, place = divmod(self.first + episode, self.evaluator.batch)
        record = jax.tree.map(lambda leaf: np.asarray(leaf[place]), self.records[batch])
        settings = self.evaluator.settings
        task = jax.tree.map(lambda leaf: np.asarray(leaf[episode]), self.tasks)
        members = slice(None) if task.active is None else task.active  # no empty slots
        return Trajectory(
            title=title,
            pursuer_position=_on_the_floor(record.pursuers[:, members]),
            pursuer_quaternion=record.quaternion[:, members],
            evader_position=record.evader,
            captured=record.captured[:, members],
            crashed=record.crashed[:, members],
            pillar_position=task.pillar_position[task.pillar_active],
            arena_radius=float(arena_of(settings, task).arena_radius),
            arena_height=settings.arena_height,
            pillar_radius=settings.pillar_radius,
            capture_radius=float(capture_radius(settings, task)),
            time_step=settings.time_step,
            seen=record.seen,
            predicted=record.predicted,
        )


def _on_the_floor(position):
    """Paths (T, N, 3) on which pursuers that have fallen out lie below where they
    did.
    """
    position = np.array(position)
    for path in position.swapaxes(0, 1):
        # who has fallen out is parked far away, which no picture could show
        is_gone = path[:, 0] > FAR / 2
        if is_gone.any():
            path[is_gone] = (*path[~is_gone][-1, :2], 0.0)
    return position


def episode_figures(statistics: EpisodeStatistics) -> dict[str, np.ndarray]:
    """Figures (B,) of single episodes, whose means are the rates of `summarise`."""
    rates = {
        "capture_rate": statistics.captured,
        "capture_step": statistics.capture_step,
        "crash_rate": statistics.crashed,
        "collision_rate": statistics.collision_rate,
        "over_speed_rate": statistics.over_speed_rate,
    }
    return {name: np.asarray(values, float) for name, values in rates.items()}


def layout_slots(settings: PursuitSettings) -> int:
    """Pillar slots that hold every layout and uniform task, so that one compiled
    evaluation serves all.
    """
    return max(settings.max_pillars, *(len(scenario.pillars) for scenario in SCENARIOS.values()))


def repeat_task(task: Task, number: int) -> Task:
    """`number` copies along a new leading axis."""
    return jax.tree.map(lambda leaf: np.broadcast_to(leaf, (number, *leaf.shape)), task)


def stack(kinds: Mapping[str, Task]) -> tuple[Task, Callable[[Any], dict[str, Any]]]:
    """Tasks of several kinds one after the other, and what parts a tree of results (B,
    ...) by their names again.
    """
    places = {}
    start = 0
    for name, tasks in kinds.items():
        end = start + tasks.evader_position.shape[0]
        places[name] = slice(start, end)
        start = end

    def part(results):
        return {
            name: jax.tree.map(operator.itemgetter(place), results)
            for name, place in places.items()
        }

    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *kinds.values()), part


def layout_tasks(
    settings: PursuitSettings, scenarios: Sequence[Scenario], episodes: int
) -> dict[str, Task]:
    """So many times each layout, by name."""
    return {
        layout.name: repeat_task(scenario_task(settings, layout), episodes) for layout in scenarios
    }
