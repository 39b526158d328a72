"""All methods over the capture radius and the evader's speed: `python experiments/sweeps.py [--episodes 50]`.

As in the paper's two figures: the radius in `empty`, the speed in `passage`; policies trained at one radius and one speed fly
at others. The radius changes nothing but what counts as a capture, so each flight tells it for all radii; all speeds fly in
one compiled call. Writes experiments/results/sweeps.json, .md and .png; `--report` writes the last two again.
"""

import argparse
import copy
import dataclasses
import functools
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from pages import page_parser, publish, spread, table, where
from roster import COLORS, METHODS, seeds_of

from openjax.commands.command_line import run_command
from openjax.commands.evaluator import layout_slots, repeat_task
from openjax.commands.machine import describe_machine
from openjax.policy import Policy, PolicyParameters
from openjax.pursuit import SCENARIOS, Pursuit, PursuitSettings, RewardSettings, Task, scenario_task
from openjax.pursuit.reward import captures
from openjax.store.policies import load_policy

RADII = (0.1, 0.15, 0.2, 0.25, 0.3, 0.35, 0.4, 0.5)
SPEEDS = (1.0, 1.2, 1.3, 1.4, 1.6, 1.8, 2.0, 2.3, 2.6)
RADIUS, SPEED = 0.3, 1.3
"""Of the training."""


@dataclasses.dataclass(frozen=True)
class SweptSettings(PursuitSettings):
    """Settings with a traced evader speed, so that one compiled function serves all."""

    def __post_init__(self):
        """A traced number can't be checked; those swept over are positive."""


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def sweep(
    environment: Pursuit,
    policy: Policy,
    radii: tuple[float, ...],
    parameters: PolicyParameters,
    tasks: Task,
    speeds: jax.Array,
    key: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """One episode of the mean policy per task.

    Args:
        environment: the game at its own radius and speed.
        policy: the networks.
        radii: (R,) capture radii (m).
        parameters: the policy's.
        tasks: leading axis B.
        speeds: (B,) m/s, of the evader.
        key: of the start attitudes.

    Returns:
        (B, R) first step with a capture within each radius, episode length + 1 where there is none; and (B, 2)
        collision rate and whether any pursuer crashed.
    """
    settings = environment.settings
    plain = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    never = settings.episode_length + 1

    def step(state, action, speed):
        swept = copy.copy(environment)
        swept.settings = SweptSettings(**{**plain, "evader_speed": speed})
        return swept.step(jax.random.key(0), state, action)[:2]

    def caught(state):
        each = [
            captures(
                dataclasses.replace(settings, capture_radius=radius),
                state.drones.position,
                state.evader_position,
                state.in_sight,
            )
            for radius in radii
        ]
        return jnp.any(jnp.stack(each), axis=-1)

    def one(carry, _):
        observation, state, first = carry
        observation, state = jax.vmap(step)(state, policy.act(parameters, observation), speeds)
        now = jnp.where(jax.vmap(caught)(state), state.step[:, None], never)
        return (observation, state, jnp.minimum(first, now)), None

    keys = jax.random.split(key, speeds.shape[0])
    observation, state = jax.vmap(environment.reset_to)(keys, tasks)
    first = jnp.full((speeds.shape[0], len(radii)), never, jnp.int32)
    start = (observation, state, first)
    (_, state, first), _ = jax.lax.scan(one, start, length=settings.episode_length)
    counted = state.statistics
    return first, jnp.stack([counted.collision_rate, counted.crashed.astype(jnp.float32)], axis=-1)


def of_policy(name: str, seed: int, episodes: int, changes: dict) -> dict:
    """Captures of one policy over the radii in `empty` and over the speeds in `passage`."""
    loaded = load_policy(name)
    game = dataclasses.replace(loaded.settings.environment, reward=RewardSettings(), **changes)
    game = dataclasses.replace(game, max_pillars=layout_slots(game))
    cells = [("empty", SPEED)] + [("passage", speed) for speed in SPEEDS]
    tasks = [repeat_task(scenario_task(game, SCENARIOS[layout]), episodes) for layout, _ in cells]
    first, counted = sweep(
        _environment(game),
        loaded.policy,
        RADII,
        loaded.parameters,
        jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *tasks),
        jnp.repeat(jnp.array([speed for _, speed in cells], jnp.float32), episodes),
        jax.random.key(seed),
    )
    first = np.asarray(first).reshape(len(cells), episodes, len(RADII))
    counted = np.asarray(counted, float).reshape(len(cells), episodes, 2).mean(axis=1)
    missed = first > game.episode_length
    rate = np.round(1 - missed.mean(axis=1), 5)
    step = np.round(np.where(missed, game.episode_length, first).mean(axis=1), 2)
    own = RADII.index(RADIUS)
    return {
        "radius": {"capture_rate": rate[0].tolist(), "capture_step": step[0].tolist()},
        "speed": {
            "capture_rate": rate[1:, own].tolist(),
            "capture_step": step[1:, own].tolist(),
            "collision_rate": np.round(counted[1:, 0], 6).tolist(),
        },
    }


@functools.cache
def _environment(settings):
    """The same object for the same game: what is compiled is found again by it."""
    return Pursuit(settings)


def study(options: argparse.Namespace) -> dict:
    """Fly every method's seeds over all radii and speeds."""
    started = time.monotonic()
    changes = {"speed_limit": options.speed_limit, "physics": options.physics}
    methods = {}
    for label in options.methods:
        methods[label] = [of_policy(name, seed, options.episodes, changes) for name, seed in seeds_of(label)]
        print(f"{time.monotonic() - started:5.0f} s  {label}", flush=True)
    limit = "" if options.speed_limit == "clamp" else f" --speed-limit {options.speed_limit}"
    return {
        "command": f"python experiments/sweeps.py --episodes {options.episodes} --physics {options.physics}{limit}",
        "commit": options.commit,
        "machine": describe_machine(),
        "seconds": time.monotonic() - started,
        "episodes": options.episodes,
        "speed_limit": options.speed_limit,
        "methods": {label: seeds for label, seeds in methods.items() if seeds},
    }


def report(results: dict) -> list[str]:
    """The page."""
    limit = "speed clamp" if results["speed_limit"] == "clamp" else "no speed clamp"
    lines = [
        "# Capture radius and evader speed",
        "",
        f"{where(results)} {results['episodes']} episodes per seed and cell, three seeds, {limit}, drawn starts. Every policy "
        f"is the one of the main table, trained or searched at a radius of {RADIUS} m and {SPEED} m/s only. Capture rate "
        "(standard deviation over seeds) / capture step. The paper shows both as figures without numbers.",
    ]
    for title, axis, values, unit in (
        ("Capture radius, in `empty`", "radius", RADII, "m"),
        ("Evader speed, in `passage`", "speed", SPEEDS, "m/s"),
    ):
        rows = []
        for label, seeds in results["methods"].items():
            cells = []
            for i in range(len(values)):
                rate = spread([seed[axis]["capture_rate"][i] for seed in seeds], 2)
                cells.append(f"{rate} / {np.mean([seed[axis]['capture_step'][i] for seed in seeds]):.0f}")
            rows.append([label, *cells])
        lines += ["", f"## {title}", "", *table(["method", *(f"{value} {unit}" for value in values)], rows)]
        lines += ["", not_above(results["methods"], axis, values, unit)]
    return [*lines, "", "![Capture rate and step over radius and speed](sweeps.png)"]


def not_above(methods: dict, axis: str, values: tuple[float, ...], unit: str) -> str:
    """Where OPEN catches less often than another method, or as often and later."""
    found = []
    for label, seeds in methods.items():
        if label == "OPEN" or "OPEN" not in methods:
            continue
        for i, value in enumerate(values):
            (rate, step), (best, early) = (
                [
                    np.mean([seed[axis][name][i] for seed in group])
                    for name in ("capture_rate", "capture_step")
                ]
                for group in (seeds, methods["OPEN"])
            )
            if rate > best + 1e-9 or (abs(rate - best) < 1e-9 and step < early):
                found.append(
                    f"{label} at {value} {unit} ({rate:.2f} / {step:.0f} against {best:.2f} / {early:.0f})"
                )
    return (
        "OPEN isn't above: " + "; ".join(found) + "." if found else "OPEN is above every method everywhere."
    )


def draw(results: dict, path: Path) -> None:
    """Capture rate and step over radius and over speed, mean and range over seeds."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 6.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, 2, sharex="col", sharey="row")
    for j, (axis, x, own, label) in enumerate(
        (
            ("radius", RADII, RADIUS, "capture radius in empty (m)"),
            ("speed", SPEEDS, SPEED, "evader speed in passage (m/s)"),
        )
    ):
        for i, name in enumerate(("capture_rate", "capture_step")):
            for method, seeds in results["methods"].items():
                values = np.array([seed[axis][name] for seed in seeds])
                line = {"color": COLORS[method], "marker": "o", "markersize": 3, "label": method}
                axes[i, j].plot(x, values.mean(axis=0), **line)
                axes[i, j].fill_between(
                    x, values.min(axis=0), values.max(axis=0), color=COLORS[method], alpha=0.15, linewidth=0
                )
            axes[i, j].axvline(own, color="black", linewidth=0.8, linestyle=":")
            axes[i, j].grid(alpha=0.3)
            axes[i, 0].set_ylabel(name.replace("_", " "))
        axes[1, j].set_xlabel(label)
    axes[0, 0].legend(fontsize="small", title="mean and range over seeds", title_fontsize="small")
    figure.savefig(path, dpi=100)


def main(arguments: list[str]) -> int:
    """Sweep or read it, write the three files, print the page."""
    parser = page_parser(__doc__, "sweeps")
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=list(METHODS))
    parser.add_argument("--episodes", type=int, default=50, help="per seed, and per radius or speed")
    parser.add_argument("--speed-limit", choices=("clamp", "none"), default="clamp")
    parser.add_argument("--physics", choices=("rigid", "mjx"), default="rigid", help="mjx: the same, slower")
    parser.add_argument("--commit", default="", help="where the machine has no repository")
    publish(parser.parse_args(arguments), study, report, draw)
    return 0


if __name__ == "__main__":
    run_command(main)
