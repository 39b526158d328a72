"""A game in which a person is the evader: steps of the simulation, one at a time."""

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from openjax.pursuit import Pursuit, Task
from openjax.pursuit.task import arena_of, capture_radius
from openjax.show.trajectory import Trajectory

if TYPE_CHECKING:
    from openjax.store.policies import LoadedPolicy


@dataclasses.dataclass(frozen=True)
class Moment:
    """One step of a game, as arrays of the host."""

    pursuer_position: np.ndarray  # (N, 3) m
    pursuer_quaternion: np.ndarray  # (N, 4) wxyz
    evader_position: np.ndarray  # (3,) m
    capture: np.ndarray  # (N,) bool, who has the evader
    crash: np.ndarray  # (N,) bool, who touches something or lies on its side
    sight: np.ndarray  # () bool, whether some pursuer sees the evader


class Simulation:
    """The compiled game of a policy against a person.

    Args:
      environment: the game.
      policy: which flies the pursuers.
      draw_task: from () key to a task.
    """

    def __init__(
        self,
        environment: Pursuit,
        policy: "LoadedPolicy",
        draw_task: Callable[[jax.Array], Task],
    ):
        self.settings = environment.settings
        self._parameters = policy.parameters

        def begin(key):
            task_key, reset_key = jax.random.split(key)
            task = draw_task(task_key)
            return environment.reset_to(reset_key, task), task

        def advance(parameters, observation, state, wish):
            action = policy.policy.act(parameters, observation)
            observation, state, _, terminated, truncated, info = environment.step(
                None, state, action, wish
            )
            moment = {
                "pursuer_position": state.drones.position,
                "pursuer_quaternion": state.drones.quaternion,
                "evader_position": state.evader_position,
                "capture": info.captured,
                "crash": info.crashed,
                "sight": info.seen,
            }
            return observation, state, terminated | truncated, moment

        self._begin = jax.jit(begin)
        self._advance = jax.jit(advance)

    def begin(self, key: jax.Array) -> "PersonsGame":
        """A game of a task that `key` draws."""
        (observation, state), task = self._begin(key)
        return PersonsGame(self, observation, state, task)

    def step(self, observation: Any, state: Any, wish: np.ndarray) -> tuple:
        """Observation and state a step later, whether the game is over, and its `Moment`."""
        observation, state, over, moment = self._advance(
            self._parameters, observation, state, jnp.asarray(wish, jnp.float32)
        )
        return observation, state, bool(over), Moment(**jax.device_get(moment))


_FIELDS = tuple(field.name for field in dataclasses.fields(Moment))


class PersonsGame:
    """One game, from its start to a capture or to the end of its time.

    `moments` has every step so far; `over` says whether it has ended.
    """

    def __init__(self, simulation: Simulation, observation: Any, state: Any, task: Task):
        self._simulation = simulation
        self._observation = observation
        self._state = state
        self._task = task
        self.start = Moment(
            *(np.asarray(value) for value in (state.drones.position, state.drones.quaternion)),
            evader_position=np.asarray(state.evader_position),
            capture=np.zeros(state.in_sight.shape, bool),
            crash=np.zeros(state.in_sight.shape, bool),
            sight=np.asarray(state.seen),
        )
        self.moments: list[Moment] = []
        self.over = False

    @property
    def is_capture(self) -> bool:
        """True if the last step was a capture."""
        return bool(self.moments) and bool(self.moments[-1].capture.any())

    @property
    def seconds(self) -> float:
        """Flown so far."""
        return len(self.moments) * self.time_step

    @property
    def time_step(self) -> float:
        """Seconds of a step."""
        return self._simulation.settings.time_step

    def step(self, wish: np.ndarray) -> None:
        """One step in which the evader wants to fly with `wish` (3,), a velocity as a
        share of its speed; a longer one is shortened to length one.
        """
        length = float(np.linalg.norm(wish))
        wish = np.asarray(wish, float) / max(1.0, length)
        self._observation, self._state, is_last, moment = self._simulation.step(
            self._observation, self._state, wish
        )
        self.moments.append(moment)
        self.over = is_last or self.is_capture

    def trajectory(self, title: str, steps: int | None = None) -> Trajectory:
        """The start and what was flown since, or so many steps of it, for the replay's page."""
        settings = self._simulation.settings
        moments = [self.start, *self.moments[:steps]]
        task = jax.device_get(self._task)
        fields = {name: np.stack([getattr(moment, name) for moment in moments]) for name in _FIELDS}
        return Trajectory(
            title=title,
            pillar_position=task.pillar_position[task.pillar_active],
            arena_radius=float(arena_of(settings, task).arena_radius),
            arena_height=settings.arena_height,
            pillar_radius=settings.pillar_radius,
            capture_radius=float(capture_radius(settings, task)),
            time_step=settings.time_step,
            pursuer_position=fields["pursuer_position"],
            pursuer_quaternion=fields["pursuer_quaternion"],
            evader_position=fields["evader_position"],
            captured=fields["capture"],
            crashed=fields["crash"],
            seen=fields["sight"],
        )
