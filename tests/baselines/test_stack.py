"""Stack with point pursuers: it catches every scripted evader inside its bound, and one
gets away close outside.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from openjax.baselines import Heuristic
from openjax.baselines.stack import planar_bound, stack_bound
from openjax.pursuit import Pursuit, PursuitSettings, uniform_task
from openjax.pursuit.evaders import draw_evader
from openjax.pursuit.evaders.behaviours import MARGIN
from tests.learning.points import game_of_points, stack_team

STEP = PursuitSettings().time_step
EVADERS = ("field", "greedy", "greedy_near", "wall_runner", "way_points")


def round_the_wall(settings, place):
    """(3,) wish of an evader at (3,) `place` that runs round the wall, half-way between
    two pursuers' heights.
    """
    between = settings.arena_height * jnp.array([1.0, 2.0]) / 3
    step = settings.evader_speed * STEP
    up = jnp.clip((between[jnp.argmin(jnp.abs(between - place[2]))] - place[2]) / step, -1.0, 1.0)
    radius = jnp.linalg.norm(place[:2])
    out = place[:2] / radius
    outward = jnp.clip((settings.arena_radius - MARGIN - radius) / step, 0.0, 1.0)
    level = outward * out + jnp.sqrt(1.0 - outward**2) * jnp.stack([-out[1], out[0]])
    return jnp.append(level * jnp.sqrt(1.0 - up**2), up)


def captures(number=64, wish=None, **changes):
    """(kinds, number) whether each scripted evader is caught, from drawn starts in an
    empty arena; (kinds, number) steps.

    With a `wish` (settings, place -> (3,)) all do as it says.
    """
    environment = game_of_points(evaders=EVADERS, episode_length=500, **changes)
    settings = environment.settings
    team = stack_team(environment)

    def fly(key, kind):
        task = uniform_task(settings, key)
        task = task.replace(pillar_active=jnp.zeros(1, bool))
        observation, state = environment.reset_to(key, task)
        state = state.replace(evader=draw_evader(settings, key, task.pursuer_position, kind=kind))

        def one(world, _):
            observation, state = world
            action = team.act({}, observation)
            wished = None if wish is None else wish(settings, state.evader_position)
            observation, state, *_ = environment.step(key, state, action, wished)
            return (observation, state), None

        return jax.lax.scan(one, (observation, state), length=settings.episode_length)[0][
            1
        ].statistics

    keys = jax.random.split(jax.random.key(0), number)
    kinds = jnp.arange(len(EVADERS))
    fly_all = jax.jit(jax.vmap(jax.vmap(fly, (0, None)), (None, 0)))
    statistics = fly_all(keys, kinds)
    return np.asarray(statistics.captured), np.asarray(statistics.capture_step)


def test_the_bound_of_the_papers_arena():
    assert stack_bound(PursuitSettings()) == pytest.approx(0.9 / (0.9 - 0.05**0.5))
    # who is midway between two heights is at the radius, and not nearer
    for number, radius in ((2, 0.3), (6, 0.1)):
        settings = PursuitSettings(num_pursuers=number, capture_radius=radius)
        assert stack_bound(settings) == planar_bound(settings) == 0.0


def test_points_capture_more_than_on_one_ray():
    for changes in ({}, {"num_pursuers": 8}, {"num_pursuers": 5, "capture_radius": 0.15}):
        settings = PursuitSettings(**changes)
        ratio = planar_bound(settings)
        assert ratio > stack_bound(settings) > 1.0
        # nearest to an evader on the wall, of all straight lines that leave the ray to
        # its side
        turned = np.linspace(0.0, np.arccos(1.0 / ratio), 200)
        place = np.stack([np.cos(turned), np.sin(turned)], axis=-1)
        distance = np.linalg.norm(place - [1.0 / ratio, 0.0], axis=-1) - turned / ratio
        half = settings.arena_height / (2 * settings.num_pursuers)
        reach = (settings.capture_radius**2 - half**2) ** 0.5 / settings.arena_radius
        assert distance.min() == pytest.approx(reach, abs=1e-6)


@pytest.mark.slow
def test_every_scripted_evader_is_caught_inside_the_bound():
    assert PursuitSettings().evader_speed < stack_bound(PursuitSettings())
    caught, steps = captures()
    assert caught.all(), dict(zip(EVADERS, caught.mean(1), strict=True))
    assert steps.max() * STEP < 4.0


@pytest.mark.slow
@pytest.mark.parametrize(("radius", "most"), [(0.29, 1.0), (0.285, 0.1)])
def test_the_bound_is_tight(radius, most):
    inside = PursuitSettings().evader_speed < stack_bound(PursuitSettings(capture_radius=radius))
    caught = captures(wish=round_the_wall, capture_radius=radius)[0][EVADERS.index("greedy")]
    assert inside == caught.all() and caught.mean() <= most


def test_it_is_a_policy_like_the_others():
    environment = Pursuit(PursuitSettings(physics="stops"))
    policy = Heuristic.for_environment("stack", environment)
    observation, _ = jax.jit(environment.reset)(jax.random.key(0))
    action = jax.jit(policy.act)(policy.parameters(), observation)
    assert action.shape == (3, 4) and np.isfinite(action).all()
