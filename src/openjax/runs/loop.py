"""The host's side of training: the compiled step, log, evaluate, checkpoint, stop when
asked or at a NaN.

Works on any carry; it knows nothing of what is trained.
"""

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from openjax.files import write_json
from openjax.interruption import StopRequest
from openjax.show.metrics import MetricsWriter
from openjax.show.progress import Progress
from openjax.store.checkpoint_files import save_state
from openjax.store.checkpoints import Checkpoints
from openjax.store.leaves import named_leaves

NOT_FINITE = "not_finite"


class Stopped(Exception):
    """A run ended before its report; the message is one line that says why."""

    status = 0
    """Of the command."""


class NotFiniteError(Stopped):
    """A NaN appeared; the message says where and what is left to look at."""

    status = 1


@dataclasses.dataclass(frozen=True)
class Plan:
    """The plan of a run."""

    total_updates: int
    steps_per_update: int
    """Environment steps of one update."""
    validation_interval: int
    """Updates between evaluations on the validation tasks; each writes a checkpoint."""
    checkpoint_seconds: float = 60.0
    """Longest time without a checkpoint."""
    time_limit: float = float("inf")
    """Seconds from the loop's begin after which to stop."""
    validate_start: bool = False
    """Validate before the next update, too: what a run starts from may be the best there
    will be, and one may have been stopped between a checkpoint and its validation.
    """
    overlap: bool | None = None
    """Start an update before the last one's metrics are read: an accelerator then never waits for
    the host.

    None: on accelerators. On a CPU nothing is gained, and a NaN stops the run one update sooner.
    """


class _Update(NamedTuple):
    """An update's results, on the device until somebody reads them."""

    number: int
    metrics: dict[str, jax.Array]
    broken: jax.Array
    """See `guarded`."""


@dataclasses.dataclass(frozen=True)
class Outcome:
    """The end of a run."""

    carry: Any
    update: int
    seconds: float
    stopped_by: str | None
    """None: all updates are done; else the signal or limit that ended it."""


def guarded(step: Callable[[Any], tuple[Any, dict]]) -> Callable:
    """`step`, a pure function carry -> (carry, metrics by name), with a check of its
    result for NaN in the same program.

    Returns:
      carry -> (carry, metrics, (L,) bool: which of the leaves of `float_leaves(carry)`
      hold a NaN).
      Infinities are left alone: they're legitimate as bounds.
    """

    def check(carry):
        carry, metrics = step(carry)
        has_nan = [jnp.any(jnp.isnan(leaf)) for leaf in float_leaves(carry).values()]
        return carry, metrics, jnp.stack(has_nan) if has_nan else jnp.zeros((0,), bool)

    return check


def float_leaves(carry: Any) -> dict[str, jax.Array]:
    """The floating-point leaves of a carry by path."""
    return {
        name: leaf
        for name, leaf in named_leaves(carry).items()
        if jnp.issubdtype(leaf.dtype, jnp.floating)
    }


class Evaluate(Protocol):
    """Says how good a carry is."""

    def __call__(self, carry: Any) -> tuple[float, dict[str, float]]:
        """Score and metrics on the validation tasks; must not touch the carry."""

    def is_ready(self) -> bool:
        """True if it would begin at once. Where it waits for the compiler, a signal ends the
        command.
        """


@dataclasses.dataclass
class Loop:
    """Training until the plan is done, a time limit, a signal or a NaN.

    Several processes run it together: each comes to the same decisions after the same update.
    """

    step: Callable
    """From `guarded`, compiled; may take the carry's buffers."""
    plan: Plan
    checkpoints: Checkpoints
    metrics: MetricsWriter | None
    """None: another process writes them."""
    progress: Progress
    directory: Path
    """The run's; the state with a NaN is left in `not_finite` there."""
    stop: StopRequest
    evaluate: Evaluate | None = None
    first_update: int = 0
    """Updates done before (a resumed run) ..."""
    seconds: float = 0.0
    """... and the training time that they took."""
    everyone: Callable[[Any], list] = lambda value: [value]
    """Gathers a value of each process, as `Processes.everyone` does."""
    began: float = dataclasses.field(default_factory=time.monotonic, init=False)
    saved_at: float = dataclasses.field(default_factory=time.monotonic, init=False)
    """The time of the last checkpoint."""
    best_score: float = dataclasses.field(default=-float("inf"), init=False)

    def run(self, carry: Any) -> Outcome:
        """Train; the carry's leaves are donated.

        Raises:
          NotFiniteError: a leaf of the carry holds a NaN.
        """
        plan = self.plan
        update = self.first_update
        pending = None
        best = self.checkpoints.best()
        if best is not None:
            self.best_score = best.score
        overlap = jax.devices()[0].platform != "cpu" if plan.overlap is None else plan.overlap
        reason, _ = self._decide()
        if plan.validate_start and self.evaluate is not None and reason is None:
            self._save(update, carry, validate=True)
        if reason is None:
            self.progress.phase("compiling the training step", announce=False)
        while update < plan.total_updates and reason is None:
            carry, values, has_nan = self.step(carry)
            update += 1
            # the update before is read while the device works on this one
            if pending is not None:
                self._finish(carry, update, pending)
            pending = _Update(update, values, has_nan)
            due = update % plan.validation_interval == 0 or update == plan.total_updates
            reason, checkpoint_due = self._decide()
            # what is saved or validated must be known to hold no NaN
            if not overlap or due or checkpoint_due or reason:
                self._finish(carry, update, pending)
                pending = None
            if due or checkpoint_due:
                self._save(update, carry, validate=due)
        self._save(update, carry)  # does nothing where it's saved already
        self.checkpoints.wait()
        # a signal during the last update came too late to stop anything
        stopped_by = reason if update < plan.total_updates else None
        return Outcome(carry, update, self._seconds(), stopped_by)

    def _seconds(self):
        return self.seconds + time.monotonic() - self.began

    def _log(self, event, update, values):
        if self.metrics is not None:
            steps = update * self.plan.steps_per_update
            self.metrics.write(event, update, steps, self._seconds(), values)

    def _finish(self, carry, update_reached, results):
        """Read, write and show the results of an update.

        Raises NotFiniteError for a NaN, and leaves the carry, which `update_reached` one
        update more where updates overlap.
        """
        update = results.number
        has_nan = np.asarray(results.broken)
        values = {name: float(value) for name, value in jax.device_get(results.metrics).items()}
        self._log("train", update, values)
        if has_nan.any():
            leaves = [name for name, bad in zip(float_leaves(carry), has_nan, strict=True) if bad]
            raise self._leave_broken_state(carry, update_reached, update, leaves, values)
        self.progress.phase("training", announce=update == self.first_update + 1)
        self.progress.update(update * self.plan.steps_per_update, values)

    def _decide(self):
        """The reason to stop, and whether a checkpoint is late: a signal to any process
        counts, and the first one's clock.
        """
        checkpoint_due = time.monotonic() - self.saved_at > self.plan.checkpoint_seconds
        decision = self.everyone(
            [self.stop.name, time.monotonic() - self.began >= self.plan.time_limit, checkpoint_due]
        )
        signals = [name for name, _, _ in decision if name is not None]
        # hosts' clocks differ, and all must decide alike
        _, over, checkpoint_due = decision[0]
        limit = "the time limit" if over else None
        return signals[0] if signals else limit, checkpoint_due

    def _save(self, update, carry, validate=False):
        """Write a checkpoint, with its score on the validation tasks where it is to have one."""
        score = None
        if validate and self.evaluate is not None:
            if not self.evaluate.is_ready():
                self.checkpoints.save(update, carry, None, {"seconds": self._seconds()})
            self.progress.phase("evaluating on validation tasks", announce=False)
            score, validation = self.evaluate(carry)
            self._log("validation", update, validation)
            self.progress.validation(validation, is_best=score >= self.best_score)
            self.best_score = max(score, self.best_score)
        self.checkpoints.save(update, carry, score, {"seconds": self._seconds()})
        self.saved_at = time.monotonic()

    def _leave_broken_state(self, carry, update_reached, update, leaves, values):
        """Save what there is to look at; the error that says where."""
        self.checkpoints.wait()
        place = Path(self.directory) / NOT_FINITE
        save_state(place / f"{update_reached:09d}", carry, {"update": update_reached})
        # JSON has no NaN
        metrics = {
            name: value if np.isfinite(value) else str(value) for name, value in values.items()
        }
        report = {
            "update": update,
            "state_after_update": update_reached,
            "leaves": leaves,
            "metrics": metrics,
        }
        if jax.process_index() == 0:
            write_json(place / "report.json", report)
        latest = self.checkpoints.latest()
        good = "there is no checkpoint yet"
        if latest:
            good = f"the last good checkpoint is {latest.path}"
        names = ", ".join(leaves[:3])
        if len(leaves) > 3:
            names += f" and {len(leaves) - 3} more"
        return NotFiniteError(
            f"stopped: NaN in update {update} in {names}; the state is in {place}, {good}"
        )
