"""The stage after MAPPO of a run: what it makes is kept where it is better on validation tasks or,
where it is for evaders that plan, worse by no more than `TOLERANCE`.
"""

import dataclasses
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax

from openjax.evaluation.validation import selection_score
from openjax.files import write_json
from openjax.learning import TrainSettings
from openjax.policy import PolicyParameters
from openjax.store.leaves import place
from openjax.store.policy_files import save_policy_file

TOLERANCE = 0.03
"""What a stage against evaders that plan may lose on the validation's scripted ones and
still be kept: they can't tell what it is for. Pursuers that press harder breach safety
distances in a third of a hundredth more of the steps, which is half of this.
"""


@dataclasses.dataclass(frozen=True)
class BestPolicy:
    """The best policy of a run so far, as it is written."""

    path: Path
    parameters: PolicyParameters
    settings: TrainSettings
    notes: dict

    def save(self) -> None:
        """Write it, in place of what is there."""
        save_policy_file(self.path, self.parameters, self.settings, self.notes, storage="float32")


def keep_best(
    policy: BestPolicy,
    learn: Callable[[PolicyParameters, jax.Array], Iterator[tuple[PolicyParameters, dict]]],
    validate: Callable[[PolicyParameters], dict],
    over: Callable[[], bool],
) -> str:
    """Take a run's policy through the last stage; the best of what it becomes and what it
    was is written.

    Args:
      policy: what the stage starts from.
      learn: (parameters, key) -> after each update the parameters and its metrics.
      validate: parameters -> summary of validation tasks by which no checkpoint was
      chosen.
      over: is asked after each update whether to stop.

    Returns:
      what to tell of it.
    """
    began = time.monotonic()
    settings = policy.settings
    # where the validation, too, was compiled for
    start = place(policy.parameters)
    length = settings.environment.episode_length
    looks = [{"update": 0, **validate(start)}]
    history = []
    best = 0
    scores = [selection_score(looks[0], length)]
    for parameters, parts in learn(start, jax.random.key(settings.seed)):
        history.append(parts)
        if over():
            break
        if not _is_looked_at(settings.analytic, len(history)):
            continue
        looks.append({"update": len(history), **validate(parameters)})
        scores.append(selection_score(looks[-1], length))
        if _is_better(settings, scores, best):
            best = len(looks) - 1
            notes = {"far_validation_score": scores[best], "analytic_updates": len(history)}
            notes = {**policy.notes, **notes}
            # at once: a stage that is ended early leaves the best of what it was
            dataclasses.replace(policy, parameters=parameters, notes=notes).save()
    facts = {
        "seconds": round(time.monotonic() - began, 1),
        "kept": looks[best]["update"],
        "validation_scores": scores,
    }
    report = policy.path.with_name("analytic.json")
    write_json(report, {**facts, "validation": list(map(_plain, looks)), "history": history})
    return _in_words(facts, len(history), scores[best])


def _plain(summary):
    """A summary as JSON holds it: nothing in place of what wasn't measured, as a prediction
    where nothing predicts.
    """
    return {name: None if value != value else value for name, value in summary.items()}


def _is_looked_at(stage, update):
    """True if what an update made is validated: every so often, and the last one."""
    return update % stage.look_every == 0 or update == stage.updates


def _in_words(facts, updates, score):
    """A line on the policy after that many updates; `score` is that of the one that is kept."""
    scores = facts["validation_scores"]
    course = f"{scores[0]:.4f} -> {score:.4f} after {facts['kept']} of {updates} updates"
    if not facts["kept"]:
        most = max(scores[1:], default=scores[0])
        course = f"{scores[0]:.4f}, at most {most:.4f} after it, not kept"
    return (
        f"by the gradient through the simulation: score on far validation tasks {course}, "
        f"{facts['seconds']:.0f} s"
    )


def _is_better(settings, scores, best):
    """True if the last of the scores is kept, beside the one at place `best` so far."""
    if settings.worst_plans.worlds:
        return scores[-1] >= scores[0] - TOLERANCE
    return scores[-1] > scores[best]
