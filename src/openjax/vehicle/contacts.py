"""The forces of contacts with solid things on a drone: MuJoCo's soft contacts, written out.

`contact_acceleration` does it for one drone and all things around it at once,
`looped_contact_acceleration` for a block of drones and one thing after the other, as a
kernel does.
"""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

from openjax.vehicle.arena import Arena
from openjax.vehicle.shapes import Components, Seconds, Vector
from openjax.vehicle.solids import Obstacles, Thing, approach, encounters, shown_gap


def contact_acceleration(
    arena: Arena,
    position: Vector,
    velocity: Vector,
    acceleration: Vector,
    around: Obstacles,
    dt: Seconds,
) -> Vector:
    """The acceleration that contacts add over a step of dt seconds to the `acceleration` (3,) m/s^2
    that a drone would have without them.

    MuJoCo's soft contacts (its documentation, "Computation": constraint model, primal
    problem) written out for a sphere without friction. They act on its centre along the
    normals, so its mass cancels and three unknowns are left,

        argmin_a |a - a_free|^2 / 2 + sum_i w_i min(0, n_i a - r_i)^2 / 2,

    with weights w_i = d / (1 - d) of the impedance d and reference accelerations r_i =
    -(b n_i v + k gap_i) / d. As the MJCF's solver does, this takes one Newton step from
    a_free: exact unless the step brings in another contact.
    """
    gaps = encounters(arena, position, velocity, around, dt)
    reference = _reference(gaps.things, gaps.normal, gaps.shown, velocity, dt)
    lacking = _along(gaps.normal, acceleration) - reference
    terms = _terms(gaps.things, gaps.normal, gaps.shown, lacking)
    return jnp.stack(_newton_step(_sums(terms)))


def looped_contact_acceleration(
    position: Components,
    velocity: Components,
    acceleration: Components,
    groups: Sequence[tuple[int, Callable[[jax.Array], Thing]]],
    dt: Seconds,
) -> Components:
    """`contact_acceleration` of a block of drones, by loops over their things: a small
    program where compiling an unrolled one would take half a minute.

    Vectors are their three components, each a block of drones. `groups`: (number,
    function of an index that gives the thing beside each drone of the block).
    """

    def add(totals, thing):
        least, sums = totals
        normal, gap, gap_ahead = approach(position, velocity, thing, dt)
        # where nothing is hit, the sums aren't used
        solver_gap = shown_gap(gap, gap_ahead, True)
        reference = _reference(thing, normal, solver_gap, velocity, dt)
        terms = _terms(thing, normal, solver_gap, _along(normal, acceleration) - reference)
        sums = tuple(a + b for a, b in zip(sums, terms, strict=True))
        return jnp.minimum(least, gap_ahead), sums

    nothing = jnp.full_like(position[0], jnp.inf), (jnp.zeros_like(position[0]),) * 9
    least, sums = _fold(add, nothing, groups)
    return _newton_step([jnp.where(least < 0.0, part, 0.0) for part in sums])


def _fold(function, start, groups):
    """`function` of what there is so far and each thing, one after the other."""
    for number, thing in groups:
        if number == 0:
            continue

        def one(k, value, thing=thing):
            return function(value, thing(k))

        start = one(0, start) if number == 1 else jax.lax.fori_loop(0, number, one, start)
    return start


def _along(normal, vector):
    x, y, z = normal
    return x * vector[0] + y * vector[1] + z * vector[2]


def _reference(thing, normal, gap, velocity, dt):
    """The acceleration along the normal that a contact asks for (m/s^2), shown a
    `gap`.
    """
    # divided in the drones' precision, as what it is compared with
    stiffness, damping, impedance = (jnp.asarray(number, gap.dtype) for number in thing.contact)
    return -(damping / dt * _along(normal, velocity) + stiffness / dt**2 * gap) / impedance


def _terms(thing, normal, gap, lacking):
    """The terms of one contact in the pull (3,) and the matrix (xx, yy, zz, xy, xz, yz) of the
    Newton step, where the free acceleration is `lacking` (< 0) against the reference.
    """
    x, y, z = normal
    impedance = jnp.asarray(thing.contact.impedance, gap.dtype)
    weight = jnp.where((gap < 0.0) & (lacking < 0.0), impedance / (1.0 - impedance), 0.0)
    pulls = [weight * lacking * part for part in normal]
    # the matrix is symmetric: six of its nine entries
    entries = ((x, x), (y, y), (z, z), (x, y), (x, z), (y, z))
    return (*pulls, *(weight * a * b for a, b in entries))


def _newton_step(sums):
    """The solution of (1 + sum_i w_i n_i n_i^T) step = -pull, by an LDL^T
    factorisation.
    """
    # written out: a kernel knows no solver, and three unknowns aren't worth a call of
    # LAPACK
    *pull, xx, yy, zz, xy, xz, yz = sums
    xx = 1.0 + xx
    yy = 1.0 + yy
    zz = 1.0 + zz
    l_y = xy / xx
    l_z = xz / xx
    d_y = yy - l_y * xy
    e = yz - l_z * xy
    l_zy = e / d_y
    d_z = zz - l_z * xz - l_zy * e
    f_y = l_y * pull[0] - pull[1]
    step_z = (l_z * pull[0] - pull[2] - l_zy * f_y) / d_z
    step_y = f_y / d_y - l_zy * step_z
    return -pull[0] / xx - l_y * step_y - l_z * step_z, step_y, step_z


def _sums(terms):
    """The sum of each over the things, by one loop: as many loops as sums would find
    the contacts anew in each. No gradient.
    """

    def add(one, other):
        return tuple(a + b for a, b in zip(one, other, strict=True))

    zeros = tuple(jnp.zeros((), term.dtype) for term in terms)
    return jax.lax.reduce(jax.lax.stop_gradient(tuple(terms)), zeros, add, (0,))
