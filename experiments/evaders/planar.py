"""The game of two points in a disc, solved: `python -m experiments.evaders.planar`.

A pursuer of speed one and an evader of speed v > 1 in a disc of radius one; both know
all. How near does the pursuer come? Below that distance as its reach it never captures,
above it always does. N pursuers that fly one above another are one such pursuer
(`openjax.baselines.stack`).

The state is the pursuer's radius, the evader's, and the angle between them. The
distance W that is reached is the least of that now and of what both sides then choose:
W = min(d, max_e min_p W'), by iteration on a grid, whose values between its points are
interpolated. If the evader shows its step first, W comes out too small, if the pursuer
does, too large; both errors shrink with the grid. Writes planar.json and .md.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.ndimage import map_coordinates

from experiments.table import Page, Table, page_parser, publish
from openjax.baselines.stack import nearest_in_disc
from openjax.command_line import run_command

RATIOS = (1.05, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.8, 2.0, 2.25, 2.5, 3.0, 3.5)


@dataclasses.dataclass(frozen=True)
class Grid:
    """How finely the game is solved."""

    radii: int
    """Of the pursuer; the angle has twice as many."""
    evader_radii: int
    """One: the evader keeps to the wall."""
    directions: int
    """Of either, beside standing still."""
    steps: float = 1.5
    """What the pursuer flies in a step, in spacings of its radii."""
    horizon: float = 5.0
    """Radii that the pursuer flies in all."""

    @property
    def step(self) -> float:
        """Time of a step, in which the pursuer flies as far."""
        return self.steps / (self.radii - 1)

    @property
    def axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Radii of the pursuer and of the evader, and angles from 0 to pi."""
        return (
            np.linspace(0.0, 1.0, self.radii),
            np.linspace(0.0, 1.0, self.evader_radii) if self.evader_radii > 1 else np.ones(1),
            np.linspace(0.0, np.pi, 2 * self.radii - 1),
        )


def moves(directions: int) -> np.ndarray:
    """(K, 2) unit vectors round the circle, and none."""
    angle = np.linspace(0.0, 2 * np.pi, directions, endpoint=False)
    return np.stack([np.append(np.cos(angle), 0.0), np.append(np.sin(angle), 0.0)], axis=-1)


def polar(radius, move):
    """Radius, at most one, and angle of a point that was at (radius, 0) and moved."""
    x = radius + move[0]
    y = move[1]
    return jnp.minimum(jnp.sqrt(x**2 + y**2), 1.0), jnp.arctan2(y, x)


@dataclasses.dataclass(frozen=True)
class PlanarGame:
    """The game of one ratio of speeds on a grid."""

    grid: Grid
    ratio: jax.Array  # ()

    @property
    def states(self) -> tuple[jax.Array, jax.Array, jax.Array]:
        """(X, Y, A) the pursuer's radius, the evader's, and the angle between them."""
        pursuer, evader, angle = np.meshgrid(*self.grid.axes, indexing="ij")
        return jnp.asarray(pursuer), jnp.asarray(evader), jnp.asarray(angle)

    def solve(self, evader_first: bool) -> jax.Array:
        """(X, Y, A) distance W that is reached from each state."""
        pursuer, evader, angle = self.states
        now = jnp.sqrt(pursuer**2 + evader**2 - 2 * pursuer * evader * jnp.cos(angle))
        last = self.evader_first if evader_first else self.pursuer_first

        def improve(_, reached):
            return jnp.minimum(now, last(reached))

        return jax.lax.fori_loop(0, round(self.grid.horizon / self.grid.step), improve, now)

    def evader_first(self, reached: jax.Array) -> jax.Array:
        """W a step earlier, where the pursuer answers the evader's step."""

        def answered(radius, turn):
            return self._least(lambda place: self._after(reached, place, (radius, turn)))

        return self._most(answered)

    def pursuer_first(self, reached: jax.Array) -> jax.Array:
        """W a step earlier, where the evader answers the pursuer's step."""

        def answered(place):
            return self._most(lambda *moved: self._after(reached, place, moved))

        return self._least(answered)

    def _least(self, value):
        """Least value of a place over the pursuer's steps."""
        pursuer = self.states[0]
        flown = jnp.asarray(moves(self.grid.directions)) * self.grid.step

        def one(best, move):
            return jnp.minimum(best, value(polar(pursuer, move))), None

        return jax.lax.scan(one, jnp.full_like(pursuer, 9.0), flown)[0]

    def _most(self, value):
        """Largest value of a radius and a turn over the evader's steps."""
        evader = self.states[1]
        reach = self.grid.step * self.ratio

        def around(best, way):
            # along the circle on which it is: on the wall a straight step would lead
            # out of the disc
            return jnp.maximum(best, value(evader, way * reach / jnp.maximum(evader, reach))), None

        def straight(best, move):
            return jnp.maximum(best, value(*polar(evader, move))), None

        least = jnp.full_like(evader, -1.0)
        best = jax.lax.scan(around, least, jnp.array([-1.0, 0.0, 1.0]))[0]
        if self.grid.evader_radii == 1:
            return best
        return jax.lax.scan(straight, best, jnp.asarray(moves(self.grid.directions)) * reach)[0]

    def _after(self, reached, place, moved):
        """W where a pursuer at `place` (radius, turn) meets an evader that `moved`
        likewise.
        """
        between = jnp.abs(self.states[2] + moved[1] - place[1])
        between = jnp.where(between > jnp.pi, 2 * jnp.pi - between, between)
        values = zip((place[0], moved[0], between), self.grid.axes, strict=True)
        index = [
            (value - axis[0]) / (axis[1] - axis[0] if len(axis) > 1 else 1.0)
            for value, axis in values
        ]
        return map_coordinates(reached, index, order=1, mode="nearest")


@functools.partial(jax.jit, static_argnums=(0, 2))
def middle_distance(grid: Grid, ratio: jax.Array, evader_first: bool) -> jax.Array:
    """() how near a pursuer comes that begins in the middle, wherever the evader is."""
    return jnp.max(PlanarGame(grid, ratio).solve(evader_first)[0])


def reached_from_the_middle(grid: Grid, ratios: tuple[float, ...]) -> list[list[float]]:
    """For each ratio how near a pursuer comes that begins in the middle, wherever the
    evader is: evader first, pursuer first.
    """
    values = jnp.asarray(ratios, jnp.float32)
    found = [
        jax.vmap(lambda ratio, first=first: middle_distance(grid, ratio, first))(values)
        for first in (True, False)
    ]
    return np.stack(found, axis=-1).round(5).tolist()


def study(options) -> dict:
    """Grids with the wall, finer and finer, and one pair in which the evader may leave
    it.
    """
    wall = [Grid(radii, 1, options.directions) for radii in options.radii]
    free = [Grid(radii, radii, options.free_directions) for radii in options.free_radii]
    alike = [dataclasses.replace(grid, evader_radii=1) for grid in free]
    return {
        "ratios": RATIOS,
        "wall": [_record(grid, RATIOS) for grid in wall],
        "free_ratios": options.free_ratios,
        "free": [_record(grid, options.free_ratios) for grid in free],
        "wall_alike": [_record(grid, options.free_ratios) for grid in alike],
    }


def _record(grid, ratios):
    reached = reached_from_the_middle(grid, tuple(ratios))
    print(grid, reached, flush=True)
    return {"grid": dataclasses.asdict(grid), "reached": reached}


def limits(records: list[dict], i: int) -> np.ndarray:
    """(2,) where both orders lead at the i-th ratio, if errors are proportional to the
    spacing of the two finest grids.
    """
    coarse, fine = records[-2:]
    wide, narrow = (1.0 / (one["grid"]["radii"] - 1) for one in (coarse, fine))
    before, after = (np.array(one["reached"][i]) for one in (coarse, fine))
    return after - (before - after) * narrow / (wide - narrow)


def values(results: dict) -> list[dict]:
    """By ratio: how near the pursuer comes to an evader that keeps to the wall, and to
    one that may leave it, which is worth what coarser grids say.
    """
    places = range(len(results["free_ratios"]))
    worth = [np.mean(limits(results["free"], i) - limits(results["wall_alike"], i)) for i in places]
    rows = []
    for i, ratio in enumerate(results["ratios"]):
        both = limits(results["wall"], i)
        leaving = float(np.interp(ratio, results["free_ratios"], worth))
        rows.append(
            {
                "ratio": ratio,
                "value": float(np.mean(both)) + leaving,
                "wall": float(np.mean(both)),
                "apart": float(np.ptp(both)),
                "formula": nearest_in_disc(ratio),
                "ray": 1.0 - 1.0 / ratio,
            }
        )
    return rows


def page(results: dict) -> Page:
    """A row for each ratio, most of them on the page."""
    columns = {
        "evader's speed": "ratio:.2f",
        "comes as near as": "value:.3f",
        "closed form": "formula:.3f",
        "to one that keeps to the wall": "wall:.3f",
        "orders apart by": "apart:.3f",
        "on one ray": "ray:.3f",
    }
    rows = values(results)
    shown = Table(columns, [row for row in rows if row["ratio"] not in (1.05, 1.4, 2.25)])
    return Page("Two points in a disc", "Distances in radii.", [Table(columns, rows)], shown)


def main(arguments: list[str]) -> None:
    """The command."""
    parser = page_parser(__doc__, "planar")
    parser.add_argument("--radii", type=int, nargs="+", default=[51, 101, 201])
    parser.add_argument("--directions", type=int, default=48)
    parser.add_argument("--free_radii", type=int, nargs="*", default=[21, 41])
    parser.add_argument("--free_directions", type=int, default=24)
    parser.add_argument("--free_ratios", type=float, nargs="*", default=[1.2, 1.5, 2.0])
    publish(parser.parse_args(arguments), study, page)


if __name__ == "__main__":
    run_command(main)
