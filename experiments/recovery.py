"""What would save pursuers that start tilted? `python -m experiments.recovery [--sees others vehicle] [--vehicles family]`.

Nearly all crashes of `flight` come within .3 s of a start that leans towards something. Here its actor learns the first half
second by the gradient through the simulation (`openjax.learning.analytic_gradient`), so what is left is what can't be done with
what the actor sees, and it may see the others' velocity and tilt, and its own vehicle's parameters, too. Tells the share of the
worlds in which something is touched within .6 s in free flight, for each kind of vehicles. Writes
experiments/results/recovery.json and .md (`--out`: others), and beside them, where the actor sees no more than before, the
policy.
"""

import dataclasses
import time

import jax
import jax.numpy as jnp

from experiments.hard_tasks import close, drawn
from experiments.pages import page_parser, publish, table, where
from experiments.vehicles import WHOLE, vehicles
from openjax.commands.command_line import run_command
from openjax.commands.validation import uniform_tasks
from openjax.files import read_json
from openjax.learning import AnalyticSettings, preset
from openjax.learning.analytic_gradient import (
    AnalyticGradient,
    compile_analytic,
    free_flight,
    side_by_side,
)
from openjax.pursuit import Pursuit, uniform_task
from openjax.pursuit.collisions import TOUCH
from openjax.pursuit.observation import rotation_axes
from openjax.pursuit.settings import OWN_FRAME
from openjax.store.policies import load_policy
from openjax.store.policy_files import WEIGHTS, load_policy_file, save_policy_file
from openjax.vehicle.family import FLIGHT_FAMILY, standard_parameters

KINDS = ("nominal", "table", WHOLE)
COUNTED = 60
"""Control steps in which crashes are counted."""
LEARNT = tuple(field.name for field in dataclasses.fields(AnalyticSettings))
"""Options that are `AnalyticSettings`."""


class Seeing(AnalyticGradient):
    """A policy whose actor is shown more than its observation."""

    sees: tuple[str, ...] = ()

    @property
    def _before_history(self):
        return self.game.self_size - OWN_FRAME * self.game.observe_history

    def actor(self, actor):
        """The policy's actor, whose weights of what is new are zero."""
        actor = jax.tree.map(lambda leaf: leaf, actor)
        encoder, first = actor["params"]["encoder"], self._before_history
        if "others" in self.sees:
            kernel = encoder["attention"]["others_kernel"]
            encoder["attention"]["others_kernel"] = jnp.pad(kernel, ((0, 6), (0, 0)))
        if "vehicle" in self.sees:  # in place of the oldest frames of its history
            kernel = encoder["self_1"]["kernel"]
            encoder["self_1"]["kernel"] = kernel.at[first : first + len(self.game.vehicles)].set(0.0)
        return actor

    def shown(self, observation, state):
        """The observation, and what else is seen."""
        return jax.vmap(self._shown)(observation, state) if self.sees else observation

    def _shown(self, observation, state):
        number = self.game.num_pursuers
        if "others" in self.sees:
            drones = self.environment.dynamics.seen(state.drones, state.vehicles)
            index = jnp.array([[j for j in range(number) if j != i] for i in range(number)])
            moving = drones.velocity[:, None] - drones.velocity[index]
            up = rotation_axes(drones.quaternion)[1][index]
            observation = observation.replace(
                others=jnp.concatenate([observation.others, moving, up], axis=-1)
            )
        if "vehicle" in self.sees:
            known, first = standard_parameters(self.game.vehicles, state.vehicles), self._before_history
            own = observation.self_state.at[:, first : first + known.shape[-1]].set(known)
            observation = observation.replace(self_state=own)
        return observation


def counter(stage: AnalyticGradient, parameters, number: int):
    """The compiled count: (actor, bounds (R, 4)) -> {kind of tasks: share of worlds in which something is touched}."""
    game = stage.game
    tasks = {
        "uniform": uniform_tasks(game, number, game.max_pillars),
        "close": drawn(game, close, number),
        "side by side": drawn(game, lambda s, key: side_by_side(s, key, uniform_task(s, key)), number),
    }
    together = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *tasks.values())
    keys = jax.random.split(jax.random.key(99), len(tasks) * number)

    @jax.jit
    def crashes(actor, bounds):
        each = jnp.broadcast_to(bounds, (len(keys), *bounds.shape))
        least = stage.fly(actor, parameters, stage.begin(together, keys, each), COUNTED)[1]
        return jnp.mean((jnp.min(least, axis=-1) < TOUCH).reshape(len(tasks), number), axis=-1)

    return lambda actor, bounds: dict(zip(tasks, map(float, crashes(actor, bounds)), strict=True))


def learnt(options) -> dict:
    """Learn, tell what came of it, keep the policy."""
    began, loaded = time.monotonic(), load_policy(options.policy)
    how = AnalyticSettings(**{name: getattr(options, name) for name in LEARNT})
    game = dataclasses.replace(loaded.settings.environment, vehicles=FLIGHT_FAMILY, rare_vehicles=0.5)
    bounds = {kind: jnp.asarray(vehicles()[kind]) for kind in KINDS}
    if options.vehicles != WHOLE:
        family = zip(FLIGHT_FAMILY, vehicles()[options.vehicles].tolist(), strict=True)
        game = dataclasses.replace(game, vehicles=tuple((entry[0], *own) for entry, own in family))
    stage = Seeing(how, free_flight(Pursuit(game)), loaded.policy)
    object.__setattr__(stage, "sees", tuple(options.sees))
    parameters = loaded.parameters.replace(actor=stage.actor(loaded.parameters.actor), critic={})
    learn = compile_analytic(stage, parameters)
    count, found = counter(stage, parameters, options.number) if options.number else None, []

    def look(update, actor):
        if count and (update % options.look_every == 0 or update == options.updates):
            crashes = {kind: count(actor, bounds[kind]) for kind in KINDS}
            found.append({"update": update, "seconds": time.monotonic() - began, "crashes": crashes})
            print(found[-1], flush=True)

    parameters, history = learn(parameters, jax.random.key(options.seed), look)
    for number in sorted({0, len(history) // 2, len(history) - 1}) if history else ():
        print(number, {name: round(value, 4) for name, value in history[number].items()}, flush=True)
    if not options.sees:
        path = WEIGHTS / f"{options.policy}.npz"
        _, settings, notes = load_policy_file(path if path.exists() else options.policy)
        save_policy_file(options.out.with_suffix(".npz"), parameters, settings, notes)
    own = {name: getattr(options, name) for name in ("policy", "sees", "vehicles", *LEARNT)}
    return own | {"seconds": time.monotonic() - began, "found": found}


def study(options) -> dict:
    """One more run beside those that stand in the file, or in the place of one alike."""
    path = options.out.with_suffix(".json")
    kept = read_json(path)["runs"] if path.exists() else []
    run = learnt(options)

    def name(run):
        return [run.get(key) for key in ("policy", "sees", "vehicles", "speed", "breach", "nominal")]

    return {"runs": [other for other in kept if name(other) != name(run)] + [run]}


def report(results: dict) -> list[str]:
    """The page."""
    runs = [run for run in results["runs"] if run["found"]]

    def cells(found):
        return [
            " / ".join(f"{share:.4f}".lstrip("0") for share in found["crashes"][kind].values())
            for kind in KINDS
        ]

    before = {run["policy"]: run["found"][0] for run in runs if "vehicle" not in run["sees"]}
    rows = [[f"{name}, before", "", "", *cells(found)] for name, found in before.items()]
    for run in runs:
        last = run["found"][-1]
        sees = " and ".join(["as before", *run["sees"]])
        rows.append(
            [f"{run['policy']}, learnt on {run['vehicles']}", sees, str(last["update"]), *cells(last)]
        )
    return [
        "# What would save pursuers that start tilted",
        "",
        f"Last run: {where(results)} Share of the worlds in which something is touched within {COUNTED / 100:.1f} s, uniform "
        "tasks / starts close to something / all pursuers side by side; free flight, drawn starts. The actor learns its first "
        "half second by the gradient through the simulation, and sees more than before where that is said. "
        + results.get("note", ""),
        "",
        *table(["policy", "sees", "updates", *(f"{kind} vehicle" for kind in KINDS)], rows),
    ]


def main(arguments: list[str]) -> int:
    """Learn and write the files."""
    parser = page_parser(__doc__, "recovery")
    usual = preset("flight").analytic
    parser.add_argument("--policy", default="flight", help="name or policy file")
    parser.add_argument("--sees", nargs="*", choices=("others", "vehicle"), default=[])
    parser.add_argument("--vehicles", choices=KINDS, default=WHOLE, help="kind that is learnt on")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--number", type=int, default=1024, help="tasks of each kind to count on; 0: none")
    parser.add_argument("--look_every", type=int, default=50)
    for name in LEARNT:
        value = getattr(usual, name)
        parser.add_argument(f"--{name}", type=type(value), default=value, help="see AnalyticSettings")
    publish(parser.parse_args(arguments), study, report)
    return 0


if __name__ == "__main__":
    run_command(main)
