"""The stages of a run by the gradient through the simulation, before MAPPO and after
it, compiled while other things are.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from openjax.background import Pending, compile_ahead
from openjax.cluster.devices import (
    compiler_options,
    everywhere,
    make_device_first_flights,
    own_copy,
)
from openjax.learning.gradient.first_flights import FirstFlights, first_game
from openjax.learning.gradient.last_flights import LastFlights
from openjax.learning.gradient.measures import SmoothFlight, free_flight
from openjax.learning.gradient.stage import CompiledStage, GradientStage, compile_stage
from openjax.learning.gradient.worst_plans import WorstPlans, planning_game
from openjax.policy import Policy, PolicyParameters
from openjax.runs.job import TrainingJob
from openjax.show.progress import duration
from openjax.store.leaves import abstract_like, place

TOGETHER = 100
"""Updates of the first stage in one call: some seconds on a CPU."""


@dataclasses.dataclass(frozen=True)
class FirstFlightsProgram:
    """The stage before MAPPO, which the compiler works on."""

    updates: int
    """Of the whole stage."""
    begin: Pending
    """Gives (parameters, key) -> the stage's carry."""
    some: Pending
    """Gives (carry, parameters before, key, updates done) -> carry, mean parts of the loss;
    `TOGETHER` updates, or all of fewer.
    """
    places: Any
    """The place of its arguments: a sharding, None for the first device."""

    def wait(self) -> None:
        """Until both are compiled."""
        self.some()
        self.begin()

    def learn(
        self,
        parameters: PolicyParameters,
        key: jax.Array,
        say: Callable[[str], None],
        over: Callable[[], bool],
    ) -> PolicyParameters | None:
        """Fresh parameters after the stage; None where it was over before it began.

        `say` is told how it goes, `over` is asked every few seconds whether to stop.
        """
        self.wait()
        if over():
            return None
        start = time.monotonic()
        # two copies, as the first call takes the carry's buffers, which may be those that
        # it begins with
        before, key = place((own_copy(parameters), key), self.places)
        carry = self.begin()(place(own_copy(parameters), self.places), key)
        for first in range(0, self.updates, TOGETHER):
            if first and over():
                break
            carry, parts = self.some()(carry, before, key, place(jnp.int32(first), self.places))
            updates_done = min(first + TOGETHER, self.updates)
            # waits for them
            loss = {name: float(value) for name, value in parts.items()}
            seconds_left = (time.monotonic() - start) * (self.updates / updates_done - 1.0)
            say(
                f"{updates_done} of {self.updates} updates, {duration(seconds_left)} left | evader "
                f"out of reach {loss['free']:.0%} of the time, the nearest pursuer "
                f"{loss['distance']:.2f} m too far, close to a crash {loss['crashes']:.1%}"
            )
        return parameters.replace(actor=carry.actor.parameters)


def compile_first_flights(
    job: TrainingJob, policy: PolicyParameters, keep: Callable | None = None
) -> FirstFlightsProgram:
    """Start to compile the stage before MAPPO, in the background.

    Args:
      job: the run's.
      policy: shapes and dtypes of its parameters; on several devices of one process,
      these share the worlds.
      keep: `recall` for the run, where traces are kept.
    """
    stage = job.settings.first_flights
    game = first_game(job.parts.environment, stage)
    flight = SmoothFlight(game, _exact(job.parts.policy))
    flights = FirstFlights(stage, flight, job.settings.generator)
    devices = _number_of_devices(policy, stage.WORLDS)
    places = None if devices == 1 else everywhere(devices)
    begin, some, shardings = make_device_first_flights(
        flights, min(TOGETHER, stage.updates), devices
    )
    key, updates_done = jax.eval_shape(lambda: (jax.random.key(0), jnp.int32(0)))
    policy, key, updates_done = abstract_like((policy, key, updates_done), places)
    carry = abstract_like(jax.eval_shape(begin, policy, key), shardings)
    if keep is not None and devices == 1:
        arguments = (carry, policy, key, updates_done)
        some = keep("first_flights", jax.jit(some), lambda: arguments, carry=carry)
    options = compiler_options(devices, brief=True)
    some = jax.jit(some, donate_argnums=0, compiler_options=options)
    # the larger one first
    some_ready = compile_ahead(some, carry, policy, key, updates_done)
    begin_ready = compile_ahead(jax.jit(begin, compiler_options=options), policy, key)
    return FirstFlightsProgram(stage.updates, begin_ready, some_ready, places)


def compile_last_stage(job: TrainingJob, policy: PolicyParameters) -> CompiledStage | None:
    """The stage after MAPPO, compiled for parameters of these shapes, see `compile_stage`;
    None where the run has none.
    """
    settings = job.settings
    if not settings.analytic.updates:
        return None
    environment = job.parts.environment
    exact = _exact(job.parts.policy)
    analytic = settings.analytic
    if not settings.worst_plans.worlds:
        flight = SmoothFlight(free_flight(environment), exact)
        lesson = LastFlights(analytic, flight)
    else:
        # networks that learned with the policy aren't in its file
        names = tuple(name for name in environment.settings.evaders if name != "learned")
        game_settings = dataclasses.replace(environment.settings, evaders=names or ("field",))
        game = free_flight(dataclasses.replace(environment, settings=game_settings))
        usual = LastFlights(analytic, SmoothFlight(game, exact))
        lesson = WorstPlans(settings.worst_plans, planning_game(game), usual, settings.generator)
    return compile_stage(GradientStage(lesson), abstract_like(policy))


def _number_of_devices(policy, worlds):
    """The number of devices that share worlds whose policy lies on some of this process; 1 if they
    can't.
    """
    places = {getattr(leaf, "sharding", None) for leaf in jax.tree.leaves(policy)} - {None}
    number = max((len(at.device_set) for at in places if at.is_fully_addressable), default=1)
    return number if worlds % number == 0 else 1


def _exact(policy: Policy) -> Policy:
    """A policy in float32: tens of steps of the simulation follow each action, too far for
    rough arithmetic.
    """
    network = dataclasses.replace(policy.network, compute_type="float32")
    return dataclasses.replace(policy, network=network)
