"""The stages of a run by the gradient through the simulation, before MAPPO and after
it, compiled while other things are.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from openjax.background import in_background
from openjax.cluster.devices import (
    compiler_options,
    everywhere,
    make_device_first_flights,
    own_copy,
)
from openjax.learning import build
from openjax.learning.analytic_gradient import AnalyticGradient, free_flight
from openjax.learning.first_flights import FirstFlights, first_game
from openjax.learning.gradient_stage import compile_stage
from openjax.learning.settings import TrainSettings
from openjax.learning.worst_plans import WorstPlans, planning_game
from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import Pursuit
from openjax.show.progress import duration
from openjax.store.leaves import abstract_like, place

TOGETHER = 100
"""Updates of the first stage in one call: some seconds on a CPU."""


def compile_last_stage(settings: TrainSettings, environment: Pursuit, policy: Any) -> Callable:
    """The stage after MAPPO, compiled for parameters of these shapes; see
    `compile_stage`.
    """
    exact = _exact(settings, environment)
    if not settings.worst_plans.worlds:
        stage = AnalyticGradient(settings.analytic, free_flight(environment), exact)
    else:
        # networks that learned with the policy aren't in its file
        names = tuple(name for name in environment.settings.evaders if name != "learned")
        game_settings = dataclasses.replace(environment.settings, evaders=names or ("field",))
        game = free_flight(dataclasses.replace(environment, settings=game_settings))
        usual = AnalyticGradient(settings.analytic, game, exact)
        stage = WorstPlans(settings.worst_plans, planning_game(game), usual, settings.generator)
    return compile_stage(stage, abstract_like(policy))


def first_flights(settings: TrainSettings, environment: Pursuit) -> FirstFlights:
    """The stage before MAPPO of a run with these settings."""
    stage = settings.first_flights
    game = first_game(environment, stage)
    exact = _exact(settings, environment)
    return FirstFlights(stage, game, exact, settings.generator)


def compile_first_flights(
    flights: FirstFlights,
    policy: Any,
    say: Callable[[str], None],
    over: Callable[[], bool],
    keep: Callable | None = None,
) -> tuple[Callable[[], Any], Callable[[PolicyParameters, jax.Array], PolicyParameters | None]]:
    """Start to compile the stage before MAPPO for parameters of these shapes, in the
    background.

    Args:
      flights: the stage.
      policy: the parameters' shapes and dtypes; on several devices of one process,
      these share the worlds.
      say: hears how it goes.
      over: is asked every few seconds whether to stop.
      keep: `recalled` for the run, where traces are kept.

    Returns:
      a function that waits for the compiler, and the stage: (fresh parameters, key) ->
      parameters; None where it was over before it began.
    """
    updates = flights.settings.updates
    devices = _number_of_devices(policy, flights.settings.worlds)
    at = None if devices == 1 else everywhere(devices)
    some_ready, begin_ready = _compiling(flights, policy, devices, at, keep)

    def learn(parameters, key):
        some = some_ready()
        begin = begin_ready()
        if over():
            return None
        start = time.monotonic()
        # a copy, as the first call takes the carry's buffers, and the parameters are
        # needed below
        parameters_there, key = place((own_copy(parameters), key), at)
        carry = begin(parameters_there, key)
        for first in range(0, updates, TOGETHER):
            if first and over():
                break
            carry, parts = some(carry, key, place(jnp.int32(first), at))
            updates_done = min(first + TOGETHER, updates)
            # waits for them
            loss = {name: float(value) for name, value in parts.items()}
            seconds_left = (time.monotonic() - start) * (updates / updates_done - 1.0)
            say(
                f"{updates_done} of {updates} updates, {duration(seconds_left)} left "
                "| evader out of reach "
                f"{loss['free']:.0%} of the time, the nearest pursuer {loss['distance']:.2f} m too "
                f"far, close to a crash {loss['crashes']:.1%}"
            )
        return parameters.replace(actor=carry.parameters.actor)

    return lambda: (some_ready(), begin_ready()), learn


def _compiling(flights, policy, devices, at, keep):
    """Some updates and the start of the stage, as the background compiles them for
    arguments that lie `at` a sharding.
    """
    begin, some, shardings = make_device_first_flights(
        flights, min(TOGETHER, flights.settings.updates), devices
    )
    key, updates_done = jax.eval_shape(lambda: (jax.random.key(0), jnp.int32(0)))
    policy, key, updates_done = abstract_like((policy, key, updates_done), at)
    carry = abstract_like(jax.eval_shape(begin, policy, key), shardings)
    if keep is not None and devices == 1:
        some = keep("first_flights", jax.jit(some), lambda: (carry, key, updates_done), carry=carry)
    options = compiler_options(devices, brief=True)
    some = jax.jit(some, donate_argnums=0, compiler_options=options)
    lowered_some = some.lower(carry, key, updates_done)
    lowered_begin = jax.jit(begin, compiler_options=options).lower(policy, key)
    # the larger one first
    return [in_background(program.compile) for program in (lowered_some, lowered_begin)]


def _number_of_devices(policy, worlds):
    """How many devices share worlds whose policy lies on some of this process; 1 where
    they can't.
    """
    places = {getattr(leaf, "sharding", None) for leaf in jax.tree.leaves(policy)} - {None}
    number = max((len(at.device_set) for at in places if at.is_fully_addressable), default=1)
    return number if worlds % number == 0 else 1


def _exact(settings: TrainSettings, environment: Pursuit) -> Policy:
    """The run's policy in float32: tens of steps of the simulation follow each action,
    too far for rough arithmetic.
    """
    policy = build(settings, environment).policy
    network = dataclasses.replace(policy.network, compute_type="float32")
    return dataclasses.replace(policy, network=network)
