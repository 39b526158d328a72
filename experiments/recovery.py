"""What would save pursuers that start tilted? `python -m experiments.recovery [--sees others vehicle] [--vehicles family]`.

Drawn starts lean by up to 36 degrees, and nearly all crashes of `flight` come within .3 s of one. Here its actor learns the
first half second alone, by the gradient of a smooth share of crashes through the simulation. Unlike MAPPO that needs no luck
in exploring, so what is left is about what cannot be done with what the actor sees. It may see the others' velocity and
tilt, and its own vehicle's parameters, too. In flight it is held to what it did. Tells the share of the worlds in which
something is touched within .6 s, for each kind of vehicles. Writes experiments/results/recovery.json and .md (`--out`:
others), and beside them, where the actor sees no more than before, the policy.
"""

import dataclasses
import time
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import optax

from experiments.hard_tasks import close, drawn
from experiments.pages import page_parser, publish, table, where
from experiments.vehicles import WHOLE, vehicles
from openjax.commands.command_line import run_command
from openjax.commands.validation import uniform_tasks
from openjax.files import read_json
from openjax.learning.adaptation import crash_share, nearest_gap
from openjax.pursuit import (
    Pursuit,
    PursuitSettings,
    RewardSettings,
    Task,
    close_starts,
    turn_task,
    uniform_task,
)
from openjax.pursuit.collisions import TOUCH, drone_distance
from openjax.pursuit.observation import rotation_axes
from openjax.pursuit.settings import OWN_FRAME
from openjax.store.policies import LoadedPolicy, load_policy
from openjax.store.policy_files import WEIGHTS, load_policy_file, save_policy_file
from openjax.vehicle import load_vehicle
from openjax.vehicle.family import FLIGHT_FAMILY, standard_parameters

KINDS = ("nominal", "table", WHOLE)
STEPS, COUNTED = 50, 60
"""Control steps that are learnt, and in which crashes are counted."""
SIDE_BY_SIDE = 0.1
"""Farthest gap beyond the safety distance of pursuers side by side (m)."""
FLIGHT, MOMENTS = 400, 12
"""Steps of the flights that the actor is held to, and how many of them it is shown."""


def side_by_side(settings: PursuitSettings, key: jax.Array, task: Task) -> Task:
    """A task whose pursuers all start beside one before them; as it was where that would breach something."""
    position = task.pursuer_position
    for i, own_key in enumerate(jax.random.split(key, position.shape[0] - 1), start=1):
        which_key, direction_key, gap_key = jax.random.split(own_key, 3)
        away = jax.random.normal(direction_key, (3,)) * jnp.array([1.0, 1.0, 0.3])
        gap = settings.drone_clearance + jax.random.uniform(gap_key, (), maxval=SIDE_BY_SIDE)
        beside = position[jax.random.randint(which_key, (), 0, i)] + gap * away / jnp.linalg.norm(away)
        position = position.at[i].set(beside)
    pillars = jnp.linalg.norm(position[:, None, :2] - task.pillar_position[None], axis=-1)
    room = settings.pillar_radius + settings.pillar_clearance
    clear = ~jnp.any(task.pillar_active & (pillars < room)) & jnp.all(
        drone_distance(position) >= settings.drone_clearance - 1e-4
    )
    return task.replace(pursuer_position=jnp.where(clear, position, task.pursuer_position))


def start(settings: PursuitSettings, key: jax.Array) -> Task:
    """A task to learn from: close to something, side by side, or any."""
    task_key, turn_key, start_key, choice_key = jax.random.split(key, 4)
    task = turn_task(turn_key, uniform_task(settings, task_key))
    near = close_starts(settings, start_key, task, 0.7)
    beside = side_by_side(settings, start_key, task)
    kind = jax.random.uniform(choice_key)
    return jax.tree.map(
        lambda a, b, c: jnp.where(kind < 0.45, a, jnp.where(kind < 0.8, b, c)), near, beside, task
    )


class Starts:
    """The first moments of a policy's game, in free flight, with what its actor may see beside its observation."""

    def __init__(self, loaded: LoadedPolicy, sees: tuple[str, ...]):
        self.loaded, self.sees, self.policy = loaded, sees, loaded.policy
        self.settings = dataclasses.replace(
            loaded.settings.environment,
            physics="rigid",
            contacts=False,
            speed_limit="none",
            vehicles=FLIGHT_FAMILY,
            rare_vehicles=0.5,
            start_attitude="drawn",
            reward=RewardSettings(),
        )
        self.before_history = self.settings.self_size - OWN_FRAME * self.settings.observe_history

    def actor(self):
        """The policy's actor, whose weights of what is new are zero."""
        actor = jax.tree.map(lambda leaf: leaf, self.loaded.parameters.actor)
        encoder, first = actor["params"]["encoder"], self.before_history
        if "others" in self.sees:
            kernel = encoder["attention"]["others_kernel"]
            encoder["attention"]["others_kernel"] = jnp.pad(kernel, ((0, 6), (0, 0)))
        if "vehicle" in self.sees:  # in place of the oldest frames of its history
            kernel = encoder["self_1"]["kernel"]
            encoder["self_1"]["kernel"] = kernel.at[first : first + len(FLIGHT_FAMILY)].set(0.0)
        return actor

    def _seen(self, environment, observation, state):
        """One world's observation with what else is seen."""
        number = self.settings.num_pursuers
        if "others" in self.sees:
            drones = environment.dynamics.seen(state.drones, state.vehicles)
            index = jnp.array([[j for j in range(number) if j != i] for i in range(number)])
            up = rotation_axes(drones.quaternion)[1]
            moving = drones.velocity[:, None] - drones.velocity[index]
            others = jnp.concatenate([observation.others, moving, up[index]], axis=-1)
            observation = observation.replace(others=others)
        if "vehicle" in self.sees:
            known = standard_parameters(self.settings.vehicles, state.vehicles)
            own = observation.self_state.at[
                :, self.before_history : self.before_history + known.shape[-1]
            ].set(known)
            observation = observation.replace(self_state=own)
        return observation

    def fly(self, actor, tasks, keys, bounds, steps: int, record: bool = False):
        """Least gap (B, N) to anything solid, drones at the end; and, to `record`, observations and predictions by step."""
        environment = Pursuit(self.settings, load_vehicle(), vehicle_bounds=bounds)
        seen = jax.vmap(lambda observation, state: self._seen(environment, observation, state))
        observation, state = jax.vmap(environment.reset_to)(keys, tasks)
        step = jax.vmap(environment.step, in_axes=(None, 0, 0))

        def one(carry, _):
            observation, state, least = carry
            shown = seen(observation, state)
            predicted = jax.lax.stop_gradient(self.policy.predict(self.loaded.parameters, observation))
            action = self.policy.action(self.policy.distribution(actor, shown, predicted)[0])
            observation, state, *_ = step(jax.random.key(0), state, action)
            least = jnp.minimum(least, nearest_gap(self.settings, state))
            return (observation, state, least), ((shown, predicted) if record else None)

        first = observation, state, jnp.full(tasks.pursuer_position.shape[:2], 9.0)
        (_, state, least), moments = jax.lax.scan(jax.checkpoint(one), first, None, length=steps)
        return least, state.drones, moments

    def moments(self, actor, keys, bounds):
        """Observations and predictions (M, ...) in flights of `actor`, after their beginnings."""
        tasks = jax.vmap(lambda key: start(self.settings, key))(keys)
        moments = self.fly(actor, tasks, keys, bounds, FLIGHT, record=True)[2]
        chosen = jax.random.randint(jax.random.key(5), (MOMENTS,), STEPS, FLIGHT)
        return jax.tree.map(lambda leaf: leaf[chosen].reshape(-1, *leaf.shape[2:]), moments)

    def loss(self, actor, before, tasks, keys, bounds, moments, hold: float):
        """What is learnt (): a smooth share of crashes, not to end fast or low, and to fly as `before` in the `moments`."""
        least, drones, _ = self.fly(actor, tasks, keys, bounds, STEPS)
        crash = jnp.mean(crash_share(least))
        speed = jnp.sqrt(jnp.sum(drones.velocity**2, axis=-1) + 1e-9)
        end = jnp.mean(jax.nn.relu(speed - 1.0)) + jnp.mean(jax.nn.relu(0.35 - drones.position[..., 2]))
        mean, log_std = self.policy.distribution(before, *moments)
        changed = (self.policy.distribution(actor, *moments)[0] - mean) * jnp.exp(-log_std)
        return crash + 0.2 * end + hold * jnp.mean(jnp.sum(changed**2, axis=-1))


def tuned(starts: Starts, bounds, options):
    """The actor after learning, and (update, {kind: crashes by tasks}) on the way."""
    settings, began = starts.settings, time.monotonic()
    optimiser = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(options.learning_rate))

    def update(actor, state, before, key, moments, share):
        task_key, reset_key = jax.random.split(key)
        tasks = jax.vmap(lambda key: start(settings, key))(jax.random.split(task_key, options.worlds))
        keys = jax.random.split(reset_key, options.worlds)
        gradient = jax.grad(starts.loss)(actor, before, tasks, keys, bounds, moments, options.hold)
        whole = jnp.isfinite(optax.global_norm(gradient))
        change, state = optimiser.update(
            jax.tree.map(lambda leaf: jnp.where(whole, leaf, 0.0), gradient), state
        )
        return optax.apply_updates(actor, jax.tree.map(lambda leaf: share * leaf, change)), state

    number = options.number
    tasks = {
        "uniform": uniform_tasks(settings, number, settings.max_pillars),
        "close": drawn(settings, close, number),
        "side by side": drawn(settings, lambda s, key: side_by_side(s, key, uniform_task(s, key)), number),
    }
    together = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *tasks.values())
    keys = jax.random.split(jax.random.key(99), len(tasks) * number)

    def crashes(actor, bounds):
        least = starts.fly(actor, together, keys, bounds, COUNTED)[0]
        return jnp.mean((jnp.min(least, axis=-1) < TOUCH).reshape(len(tasks), number), axis=-1)

    actor = before = starts.actor()
    state, key = optimiser.init(actor), jax.random.key(options.seed)
    flown = jax.random.split(jax.random.key(3), options.worlds)
    moments = jax.eval_shape(starts.moments, before, flown, bounds)
    lowered = [
        jax.jit(starts.moments).lower(before, flown, bounds),
        jax.jit(update).lower(actor, state, before, key, moments, jnp.float32(1.0)),
        jax.jit(crashes).lower(actor, bounds),
    ]
    with ThreadPoolExecutor() as pool:
        record, update, crashes = pool.map(lambda program: program.compile(), lowered)
    moments, limit, found = record(before, flown, bounds), 60.0 * options.minutes, []
    for i in range(options.updates + 1):
        done = max(i / options.updates, (time.monotonic() - began) / limit)
        if i % options.look_every == 0 or done >= 1.0:
            counted = {}
            for kind in KINDS:
                shares = crashes(actor, jnp.asarray(vehicles()[kind]))
                counted[kind] = {name: float(share) for name, share in zip(tasks, shares, strict=True)}
            found.append({"update": i, "seconds": time.monotonic() - began, "crashes": counted})
            print(found[-1], flush=True)
        if done >= 1.0:
            break
        actor, state = update(
            actor, state, before, jax.random.fold_in(key, i), moments, jnp.float32(max(0.05, 1.0 - done))
        )
    return actor, found


def learnt(options) -> dict:
    """Learn, tell what came of it, keep the policy."""
    began, loaded = time.monotonic(), load_policy(options.policy)
    starts = Starts(loaded, tuple(options.sees))
    actor, found = tuned(starts, jnp.asarray(vehicles()[options.vehicles]), options)
    if not options.sees:
        path = WEIGHTS / f"{options.policy}.npz"
        _, settings, notes = load_policy_file(path if path.exists() else options.policy)
        parameters = loaded.parameters.replace(actor=actor, critic={})
        save_policy_file(options.out.with_suffix(".npz"), parameters, settings, notes)
    own = {"policy": options.policy, "sees": options.sees, "vehicles": options.vehicles}
    return own | {"seconds": time.monotonic() - began, "found": found}


def study(options) -> dict:
    """One more run beside those that stand in the file, or in the place of one alike."""
    path = options.out.with_suffix(".json")
    kept = read_json(path)["runs"] if path.exists() else []
    run = learnt(options)

    def name(run):
        return run["policy"], tuple(run["sees"]), run["vehicles"]

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
    parser.add_argument("--policy", default="flight", help="name or policy file")
    parser.add_argument("--sees", nargs="*", choices=("others", "vehicle"), default=[])
    parser.add_argument("--vehicles", choices=KINDS, default=WHOLE, help="kind that is learnt on")
    parser.add_argument("--updates", type=int, default=600)
    parser.add_argument("--minutes", type=float, default=60.0, help="at most, compilation included")
    parser.add_argument("--worlds", type=int, default=320, help="of an update")
    parser.add_argument("--learning_rate", type=float, default=3e-4)
    parser.add_argument("--hold", type=float, default=0.05, help="weight of flying as before")
    parser.add_argument("--number", type=int, default=1024, help="tasks of each kind to count on")
    parser.add_argument("--look_every", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    publish(parser.parse_args(arguments), study, report)
    return 0


if __name__ == "__main__":
    run_command(main)
