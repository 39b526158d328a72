"""The evader of one world: which it is, its numbers and its memory, drawn at the start;
and its velocity in each step.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PRNGKeyArray

from openjax.errors import UserError, part_name
from openjax.pursuit.evaders.behaviours import BEHAVIOURS, MEMORY, Scene, into_free_space
from openjax.pursuit.evaders.evader_state import EvaderState
from openjax.pursuit.evaders.field import field_velocity
from openjax.pursuit.evaders.kinds import NUMBERS, UNBOUNDED, EvaderKind, evader_rows
from openjax.pursuit.evaders.learned import STEPS, learning
from openjax.pursuit.sensing import is_open
from openjax.pursuit.settings import PursuitSettings
from openjax.pursuit.shapes import Count, Scalar, Team, Vector
from openjax.pursuit.state import PursuitState
from openjax.pursuit.task import evader_speed
from openjax.vehicle.vectors import length


def draw_evader(
    settings: PursuitSettings,
    key: PRNGKeyArray,
    pursuers: Team,
    share: Scalar | None = None,
    kind: Count | None = None,
) -> EvaderState | None:
    """`draw_row` of the shipped evaders that the settings name."""
    return draw_row(evader_rows(settings.evaders), key, pursuers, share, kind)


def draw_row(
    rows: tuple[EvaderKind, ...],
    key: PRNGKeyArray,
    pursuers: Team,
    share: Scalar | None = None,
    kind: Count | None = None,
) -> EvaderState | None:
    """The evader of an episode; None for the paper's, which has nothing to draw.

    Args:
      rows: evaders, drawn with equal odds.
      key: ().
      pursuers: (N, 3) m, their starts, for the memory of a learned evader.
      share: () from 0 to 1, how far a curriculum has come; None is 1. At 0 all worlds
        have the first of the evaders; from there the others' odds grow to the equal
        ones, and their speed from half to the whole.
      kind: () int32, the place in `rows` of the one it is; None draws it.

    Raises:
      UserError: one's own remembers more than fits beside a learned one's memory.
    """
    # the paper's has no numbers to draw and no memory: its game carries nothing for
    # them
    behaviours = [row.behaviour for row in rows]
    if set(behaviours) == {"field"}:
        return None
    kind_key, number_key, memory_key = jax.random.split(key, 3)
    if kind is None:
        kind = jax.random.randint(kind_key, (), 0, len(rows))
    slow = jnp.ones(())
    if share is not None:
        # at half the speed when they come in: who can't catch yet learns nothing from
        # one that is always away
        kind = jnp.where(jax.random.uniform(jax.random.fold_in(kind_key, 1)) < share, kind, 0)
        slow = jnp.where(kind == 0, 1.0, 0.5 + 0.5 * share)
    draws = jax.random.uniform(number_key, (len(NUMBERS),))
    numbers = {
        number: _draw([getattr(row, number) for row in rows], kind, draw)
        for number, draw in zip(NUMBERS, draws, strict=True)
    }
    numbers["speed"] = numbers["speed"] * slow
    memory = jax.random.uniform(memory_key, (MEMORY,))
    more = max(row.memory for row in rows) - MEMORY
    if "learned" in behaviours:
        if more:
            raise UserError(
                f"evaders: beside learned ones, one's own remembers {MEMORY} numbers, not "
                f"{MEMORY + more}"
            )
        # as if all pursuers had waited at their starts
        memory = jnp.concatenate([memory, jnp.tile(pursuers.ravel(), STEPS)])
    elif more:
        memory = jnp.concatenate([memory, jnp.zeros(more)])
    draws_itself = any(map(callable, behaviours))
    return EvaderState(kind, numbers, memory, memory_key if draws_itself else None)


def _draw(values, kind, draw):
    """One of `values[kind]`, by the uniform `draw`."""
    # a table needs rows of one length: filled up with zeros, which no draw reaches
    width = max(len(row) for row in values)
    table = np.array([[*row, *[0.0] * (width - len(row))] for row in values], np.float32)
    lengths = np.array([len(row) for row in values], np.float32)
    place = (draw * jnp.asarray(lengths)[kind]).astype(jnp.int32)
    return jnp.asarray(table)[kind, place]


def evader_velocity(
    settings: PursuitSettings,
    rows: tuple[EvaderKind, ...],
    world: PursuitState,
    wish: Vector | None = None,
) -> tuple[Vector, EvaderState | None]:
    """(3,) velocity (m/s, world) of the evader of a world in this step, and its state
    after it.

    Evaders other than the paper's neither leave the arena nor enter a pillar, and no
    gradient goes through what they decide.

    Args:
      settings: the game.
      rows: its evaders.
      world: before this step.
      wish: (3,) a velocity, as a share of its speed, that is flown in place of its own;
      None or NaN is its own.
    """
    if world.evader is None and wish is None:
        return _field(settings, world), None
    # what they decide is a choice among directions, which has no gradient
    world = jax.lax.stop_gradient(world)
    state = world.evader
    if state is None:
        velocity = _fly(settings, world, evader_speed(settings, world.task), UNBOUNDED, wish)
        return jnp.where(jnp.any(jnp.isnan(wish)), _field(settings, world), velocity), None
    own_wish, memory = _wish(settings, rows, world)
    by_itself = jnp.ones((), bool) if wish is None else jnp.any(jnp.isnan(wish))
    speed = state.numbers["speed"] * evader_speed(settings, world.task)
    wish = own_wish if wish is None else jnp.where(by_itself, own_wish, wish)
    velocity = _fly(settings, world, speed, state.numbers["acceleration"], wish)
    is_field = np.array([row.behaviour == "field" for row in rows])
    if is_field.any():
        # the paper's flies its force as it is: nothing bounds its acceleration
        flies_field = by_itself & jnp.asarray(is_field)[state.kind]
        velocity = jnp.where(flies_field, _field(settings, world), velocity)
    return velocity, state.replace(memory=memory)


def scene_of(settings: PursuitSettings, world: PursuitState) -> Scene:
    """The knowledge of a world's evader."""
    numbers = world.evader.numbers
    key = world.evader.key
    is_known = world.in_sight | (numbers["sees_all"] > 0.5)
    return Scene(
        settings=settings,
        position=world.evader_position,
        velocity=world.evader_velocity,
        pursuers=world.drones.position,
        known=is_known if world.active is None else is_known & world.active,
        pillar_position=world.task.pillar_position,
        pillar_active=world.task.pillar_active,
        look_ahead=numbers["look_ahead"],
        hiding=numbers["hiding"],
        reach=numbers["speed"] * evader_speed(settings, world.task),
        drones=world.drones,
        world=world,
        key=None if key is None else jax.random.fold_in(key, world.step),
        active=world.active,
    )


def _field(settings, world):
    velocity = field_velocity(
        settings,
        world.evader_position,
        world.drones.position,
        world.in_sight,
        world.task.pillar_position,
        world.task.pillar_active,
    )
    task_speed = world.task.evader_speed
    return velocity if task_speed is None else velocity * (task_speed / settings.evader_speed)


def _wish(settings, rows, world):
    """Wish (3,) and memory of an evader with a behaviour; of the paper's something
    finite.
    """
    state = world.evader
    behaviours = [row.behaviour for row in rows]
    handed_in = {row.behaviour: _like_shipped(row) for row in rows if callable(row.behaviour)}
    functions = {**BEHAVIOURS, "learned": learning, **handed_in}
    # mapped over worlds, a switch works all of them out and selects: each behaviour
    # stands in it once, however many rows have it
    in_game = [name for name in functions if name in behaviours]
    place = [in_game.index(name) if name in in_game else 0 for name in behaviours]
    scene = scene_of(settings, world)
    # the scene isn't handed in: its arena may be a number of this world, which settings
    # that a program is told apart by can't hold
    return jax.lax.switch(
        jnp.asarray(np.array(place, np.int32))[state.kind],
        [functools.partial(functions[name], scene) for name in in_game],
        state.memory,
    )


def _like_shipped(row):
    """A behaviour like the shipped ones, of a row whose function gives m/s and has a
    memory of its own size.
    """

    def behaviour(scene, memory):
        result = row.behaviour(scene, memory[: row.memory])
        velocity, next_memory = _check(row, result)
        # all evaders of a game have memories of one size, the largest
        memory = jnp.concatenate([next_memory, memory[row.memory :]])
        return velocity / jnp.maximum(scene.reach, 1e-6), memory

    return behaviour


def _check(row, result):
    """The velocity and memory that a function of one's own gives. Raises UserError
    where they have other shapes.
    """
    shapes = [jnp.shape(part) for part in jax.tree.leaves(result)]
    if shapes != [(3,), (row.memory,)]:
        raise UserError(
            f"evader {part_name(row.behaviour)} gives arrays of shapes {shapes}; velocity "
            f"(3,), memory ({row.memory},) would be right"
        )
    return result


def _fly(settings, world, speed, acceleration, wish):
    """(3,) m/s, what is flown of a wish: bounded in speed and acceleration, and past
    what is solid.
    """

    def at_most(vector, limit):
        return vector * jnp.minimum(1.0, limit / length(vector))

    dt = settings.time_step
    start = world.evader_position
    previous = world.evader_velocity
    velocity = at_most(previous + at_most(speed * wish - previous, acceleration * dt), speed)
    # past what is solid it slides along the surface: where it would end is moved out of
    # there
    pillars = world.task.pillar_position
    active = world.task.pillar_active
    place = into_free_space(settings, start + dt * velocity, pillars, active)
    velocity = at_most((place - start) / dt, speed)
    # between pillars that touch, what leads out of one may lead into another
    end = start + dt * velocity
    free = is_open(settings, end, pillars, active)
    free &= (end[2] > 0.0) & (end[2] < settings.arena_height)
    return jnp.where(free, velocity, 0.0)
