"""A run's report: its first and its best policy, and another one, in layouts and
validation tasks; table and pictures.
"""

import dataclasses
from collections.abc import Sequence

import jax
from rich.table import Table

from openjax.evaluation.evaluator import layout_tasks
from openjax.evaluation.validation import ValidationTasks
from openjax.files import write_json
from openjax.runs.job import TrainingJob
from openjax.runs.loop import Outcome
from openjax.runs.words import layouts_like
from openjax.show.metrics import METRICS_FILE
from openjax.show.number_tables import numbers_table
from openjax.show.progress import Progress
from openjax.store.policy_files import fill, load_policy_file
from openjax.store.run_directory import RunDirectory

_BESIDE_RECORD = ("episode_return", "last_seen_error")


def report(
    job: TrainingJob,
    directory: RunDirectory,
    validation: ValidationTasks,
    outcome: Outcome,
    progress: Progress,
) -> Table:
    """Evaluate the first and the best policy on the layouts, draw the best one's
    flights; the table of both.
    """
    settings = job.settings
    layouts = layouts_like(settings.environment)
    abstract = jax.eval_shape(lambda: outcome.carry.policy)
    rows = {}
    for moment, path in (("before", directory.start_policy), ("after", directory.policy)):
        progress.phase(f"evaluating the policy {moment} training on the layouts")
        parameters = fill(abstract, load_policy_file(path)[0], str(path))
        kinds, pictures = _fly(validation, parameters, layouts, job.command.layout_episodes)
        rows[moment] = [kind.record(_BESIDE_RECORD) for kind in kinds]
    # of the trained policy, which comes last
    flights = [kind.trajectory(episode, title) for kind, episode, title in pictures]
    other_rows, other_flights = _compare(job, layouts, validation.number, progress)
    progress.phase("drawing")
    facts = {
        **({job.command.compare_with: other_rows} if other_rows else {}),
        "updates": outcome.update,
        "steps": outcome.update * settings.steps_per_update,
        "seconds": round(outcome.seconds, 1),
        **job.facts,
    }
    write_json(directory.path / "layouts.json", {**rows, **facts})
    _draw(directory, flights, other_flights)
    progress.phase("done", announce=False)
    return before_after_table(
        rows["before"],
        rows["after"],
        settings.environment.time_step,
        job.command.compare_with,
        other_rows,
    )


def _compare(job, layouts, validation, progress):
    """Records and flights of the policy beside which the run's is shown; none without one."""
    if job.other is None:
        return [], []
    progress.phase(f"evaluating {job.command.compare_with} in the same game")
    # its networks may be large, and these are minutes on a small machine
    return job.other.fly(layouts, min(job.command.layout_episodes, 8), min(validation, 32))


def _fly(validation, parameters, layouts, episodes):
    """Validation tasks and layouts, flown by a policy; and what to draw of them: (kind, episode,
    title), a flight of each layout, or some validation tasks where no layout fits the game.
    """
    kinds_flown = validation(parameters)
    if not layouts:
        number = min(3, validation.number)
        return kinds_flown, [(kinds_flown[0], i, f"validation task {i + 1}") for i in range(number)]
    evaluator = validation.evaluator
    tasks = layout_tasks(evaluator.settings, layouts, episodes)
    kinds = evaluator.fly(parameters, tasks, jax.random.key(0))
    return [*kinds_flown, *kinds], [(kind, 0, kind.name) for kind in kinds]


def _draw(directory, flights, other_flights):
    """Curves, paths and the chase."""
    from openjax.show.plots import plot_training, plot_trajectories
    from openjax.show.videos import animate

    plot_training(directory.path / "training.png", directory.path / METRICS_FILE)
    plot_trajectories(directory.path / "trajectories.png", flights)
    # a chase that ends well shows what the game is about; beside it the other policy's,
    # from the same start
    captures = [flight for flight in flights if flight.capture_index is not None]
    best_flight = (captures or flights)[0]
    beside = [
        flight for flight in other_flights if flight.title.startswith(f"{best_flight.title}, ")
    ]
    if beside:
        best_flight = dataclasses.replace(best_flight, title=f"{best_flight.title}, this run")
    animate(directory.path / "chase.gif", [best_flight, *beside])


_KINDS = {"validation": "new tasks", "validation_far": "far starts"}
"""Names of the rows that aren't layouts."""


def before_after_table(
    first: Sequence[dict],
    records: Sequence[dict],
    time_step: float,
    other: str | None = None,
    other_rows: Sequence[dict] = (),
) -> Table:
    """Captures, collisions and crashes before and after training; last what the policy
    `other` does in the same game.

    Capture steps are of `time_step` seconds in all records. Beside another policy there
    is no room for collisions.
    """
    columns = [
        ("capture\nrate", "capture_rate", 1.0, ".2f"),
        ("seconds to\nthe capture", "capture_step", time_step, ".1f"),
        ("collision\nrate", "collision_rate", 1.0, ".3f"),
        ("crash\nrate", "crash_rate", 1.0, ".2f"),
    ]
    last = []
    if other is not None:
        del columns[2]
        last.append(f"policy {other}:\nrate, seconds, crash")
    heads = ["", *(head for head, *_ in columns), *last]
    table = numbers_table("Before and after training, in the game that was trained", heads)
    by_scenario = {row["scenario"]: row for row in other_rows}

    def numbers(row):
        return [f"{unit * row[name]:{style}}" for _, name, unit, style in columns]

    for old, new in zip(first, records, strict=True):
        pairs = zip(numbers(old), numbers(new), strict=True)
        cells = [f"{old_number} → {new_number}" for old_number, new_number in pairs]
        if last:
            row = by_scenario.get(old["scenario"])
            cells.append(", ".join(numbers(row)) if row else "–")
        table.add_row(_KINDS.get(old["scenario"], old["scenario"]), *cells)
    return table
