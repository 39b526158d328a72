"""Teams of strangers, and two evaders at once: `python -m
experiments.evaders.strangers`.

Mixed teams of three, by the protocol of ad hoc teamwork (JaxAHT): a policy plays with
teammates that it never trained with, one or two of them, each seat in turn; its
captures are set beside those of three such teammates alone, on the same tasks.
Intervals are bootstrapped over episodes within each teammate. Nothing was chosen by any
of it.

Then four pursuers after two evaders: which of them goes for whom is chosen by evaders
of the training, the figure is that against held-out ones. Writes strangers.json and
.md.
"""

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from experiments.evaders.mixed_teams import Strangers, bootstrap_mean
from experiments.evaders.several_evaders import CHOICES, SeveralEvaders, several_tasks
from experiments.table import Page, Table, page_parser, publish
from openjax.command_line import run_command
from openjax.evaluation.episodes import wilson
from openjax.pursuit import Pursuit, PursuitSettings, RewardSettings, uniform_task
from openjax.pursuit.evaders.kinds import HELD_OUT
from openjax.store.policies import load_policy

EGOS = ("teams", "evaders")
TEAMMATES = ("flight", "flight_seed_1", "flight_seed_2", "no_clamp_seed_0", "janosov")
"""Those that neither of `EGOS` trained with: three seeds of one recipe, another recipe,
a heuristic.
"""
SEEDS = ("flight", "flight_seed_1", "flight_seed_2")
TRAINED_WITH = ("field", "greedy", "wall_runner", "slow_hugger")
"""Evaders of the training."""


def game_of(policy: str, number: int, evaders: tuple[str, ...]) -> PursuitSettings:
    """A policy's game with so many pursuers, nominal vehicles, and evaders 1.3 times as
    fast.
    """
    trained = load_policy(policy).settings.environment
    game = dataclasses.replace(
        trained.of_one_team(number),
        evaders=evaders,
        vehicles=(),
        rare_vehicles=0.0,
        fall_outs=0.0,
        # counts for nothing here: no shortest paths
        reward=RewardSettings(),
    )
    return dataclasses.replace(game, evader_speed=1.3 * game.max_speed, capture_radius=0.3)


def teams_of(egos: tuple[str, ...], mates: tuple[str, ...]) -> list[tuple[str, ...]]:
    """All teams of three that are flown: of one policy, of an ego with one or two
    teammates, of three seeds or egos, and of three methods.
    """
    found = [(name,) * 3 for name in (*egos, *mates)]
    found += [(ego, mate, mate) for ego in egos for mate in mates]
    found += [(ego, ego, mate) for ego in egos for mate in mates]
    whole = (SEEDS, egos, (*egos, mates[0]))
    return found + [team for team in whole if len(team) == 3 and set(team) <= {*egos, *mates}]


def fly_teams(options) -> dict:
    """Captures and crashes (episodes,) of each team on the same tasks, by its members'
    names.
    """
    names = (*options.egos, *options.mates)
    game = game_of(options.egos[0], 3, HELD_OUT)
    environments = []
    policies = []
    parameters = []
    for name in names:
        loaded = load_policy(name)
        environment = Pursuit(game.observed_as(loaded.settings.environment))
        loaded = loaded.in_game(environment)
        environments.append(environment)
        policies.append(loaded.policy)
        parameters.append(loaded.parameters)
    fly = jax.jit(Strangers(tuple(environments), tuple(policies)).fly)
    keys = jax.random.split(jax.random.key(options.seed), options.episodes)
    tasks = jax.vmap(functools.partial(uniform_task, game))(keys)
    found = {}
    for team in teams_of(options.egos, options.mates):
        places = np.array([names.index(name) for name in team])
        # each seat in turn, as seats aren't alike to an evader that starts on one side
        members = np.stack([np.roll(places, i) for i in range(options.episodes)])
        flown = fly(tuple(parameters), tasks, jnp.asarray(members), jax.random.key(options.seed))
        found[team] = np.asarray(flown.captured), np.asarray(flown.crashed)
        print(team, found[team][0].mean(), found[team][1].mean(), flush=True)
    return found


def record(captured: np.ndarray, crashed: np.ndarray) -> dict:
    """Captures with their interval of 95 %, and crashes, of episodes (E,)."""
    return {
        "episodes": len(captured),
        "capture_rate": float(captured.mean()),
        "interval": list(wilson(int(captured.sum()), len(captured))),
        "crash_rate": float(crashed.mean()),
    }


def with_strangers(flown: Mapping, ego: str, mates: tuple[str, ...], seats: int) -> dict:
    """An ego on so many seats over all teammates: the mean of its captures, and of
    these less those of three such teammates, with intervals.
    """
    teams = [(ego,) * seats + (mate,) * (3 - seats) for mate in mates]
    own = np.stack([flown[team][0] for team in teams]).astype(float)
    theirs = np.stack([flown[(mate,) * 3][0] for mate in mates]).astype(float)
    crashes = np.stack([flown[team][1] for team in teams])
    return {
        "ego": ego,
        "seats": seats,
        "capture_rate": float(own.mean()),
        "interval": list(bootstrap_mean(own)),
        "gain": float((own - theirs).mean()),
        "gain_interval": list(bootstrap_mean(own - theirs)),
        "crash_rate": float(crashes.mean()),
    }


def fly_two(options) -> list[dict]:
    """Four pursuers after two evaders: a record for each choice of targets, against
    evaders of the training and held-out ones.
    """
    evaders = (*TRAINED_WITH, *HELD_OUT)
    loaded = load_policy(options.egos[0])
    environment = Pursuit(game_of(options.egos[0], options.pursuers, evaders))
    loaded = loaded.in_game(environment)
    choices = list(CHOICES.values())

    @jax.jit
    def fly(parameters, keys, kinds, choice):
        def one(key, kind):
            tasks = several_tasks(environment.settings, key, 2).replace(evader=kind)
            several = SeveralEvaders(
                environment, loaded.policy, lambda *world: jax.lax.switch(choice, choices, *world)
            )
            return several.fly(parameters, tasks, key)

        return jax.vmap(one)(keys, kinds)

    keys = jax.random.split(jax.random.key(options.seed), options.episodes)
    generator = np.random.default_rng(options.seed)
    records = []
    for kind, names in {"training": TRAINED_WITH, "held out": HELD_OUT}.items():
        places = [evaders.index(name) for name in names]
        kinds = jnp.asarray(generator.choice(places, size=(options.episodes, 2)), jnp.int32)
        for i, name in enumerate(CHOICES):
            flown = fly(loaded.parameters, keys, kinds, jnp.int32(i))
            both = np.asarray(flown.caught).all(axis=1)
            own = record(both, np.asarray(flown.pursuers.crashed))
            seconds = np.asarray(flown.steps).max(axis=1)[both] * environment.settings.time_step
            one = float(np.asarray(flown.caught).any(axis=1).mean())
            mean = float(seconds.mean()) if both.any() else None
            records.append(
                {"evaders": kind, "choice": name, **own, "one_caught": one, "seconds": mean}
            )
            print(records[-1], flush=True)
    return records


def study(options) -> dict:
    """Both parts, or the one that is asked for."""
    two = {"pursuers": options.pursuers, "records": []}
    if options.only != "teams":
        two["records"] = fly_two(options)
    if options.only == "two":
        return {"teams": [], "strangers": [], "two": two}
    flown = {
        tuple(name_of(policy) for policy in team): own for team, own in fly_teams(options).items()
    }
    mates = tuple(name_of(mate) for mate in options.mates)
    return {
        "teams": [{"members": list(team), **record(*own)} for team, own in flown.items()],
        "strangers": [
            with_strangers(flown, name_of(ego), mates, seats)
            for ego in options.egos
            for seats in (1, 2)
        ],
        "two": two,
    }


def name_of(policy: str) -> str:
    """A policy's name, or that of its file without folder and ending."""
    return Path(policy).stem


def page(results: Mapping) -> Page:
    """What an ego gains beside strangers, then all teams, then two evaders."""
    rows = [
        {"team": f"{row['ego']} on {row['seats']} of three seats, strangers on the others", **row}
        for row in results["strangers"]
    ]
    mixed = [row for row in results["teams"] if len(set(row["members"])) == 3]
    rows += [{**row, "team": ", ".join(row["members"])} for row in mixed]
    # None where that part wasn't flown
    chosen = chosen_choice(results["two"]["records"])
    rows += [
        {**row, "team": f"{results['two']['pursuers']} after two evaders, {row['choice']}"}
        for row in results["two"]["records"]
        if row["evaders"] == "held out" and row["choice"] == chosen
    ]
    columns = {
        "team": "team",
        "captures": "capture_rate:.3f",
        "95 %": lambda row: "{:.3f} to {:.3f}".format(*row["interval"]),
        "more than its teammates alone": "gain:+.3f",
        "crash rate": "crash_rate:.3f",
    }
    short = Table(columns, rows)
    every = {"members": lambda row: ", ".join(row["members"])} | {
        head: columns[head] for head in ("captures", "95 %", "crash rate")
    }
    two = {"evaders": "evaders", "who goes for whom": "choice", "one caught": "one_caught:.3f"}
    two |= {head: columns[head] for head in ("captures", "95 %", "crash rate")}
    parts = [
        short,
        Table(every, results["teams"], "All teams"),
        Table(two, results["two"]["records"]),
    ]
    return Page(
        "Teams of strangers, and two evaders", "Three pursuers, uniform tasks.", parts, short
    )


def chosen_choice(records: list[dict]) -> str | None:
    """The choice of targets that catches both most often among evaders of the
    training.
    """
    own = [row for row in records if row["evaders"] == "training"]
    return max(own, key=lambda row: row["capture_rate"])["choice"] if own else None


def draw(results: Mapping, path: Path) -> None:
    """Captures of each ego with each teammate, beside three of that teammate."""
    rates = {tuple(row["members"]): row["capture_rate"] for row in results["teams"]}
    mates = [team[0] for team in rates if len(set(team)) == 1 and team[0] not in _egos(results)]
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    axes = figure.subplots()
    place = np.arange(len(mates))
    shown = {"three of them": [rates[(mate,) * 3] for mate in mates]}
    for ego in _egos(results):
        for seats in (1, 2):
            teams = [(ego,) * seats + (mate,) * (3 - seats) for mate in mates]
            shown[f"{seats} of {ego}"] = [rates[team] for team in teams]
    for i, (label, values) in enumerate(shown.items()):
        axes.bar(place + 0.16 * (i - 2), values, 0.15, label=label)
    axes.set_xticks(place, mates)
    axes.set(ylabel="episodes with a capture", ylim=(0, 1))
    axes.legend(fontsize="small", ncols=3, loc="lower left")
    figure.savefig(path, dpi=120)


def _egos(results):
    return list(dict.fromkeys(row["ego"] for row in results["strangers"]))


def main(arguments: list[str]) -> None:
    """The command."""
    parser = page_parser(__doc__, "strangers")
    parser.add_argument("--egos", nargs="+", default=EGOS, help="policies (the first flies two)")
    parser.add_argument("--mates", nargs="+", default=TEAMMATES)
    parser.add_argument("--only", choices=("teams", "two"), help="one of the two parts")
    parser.add_argument("--episodes", type=int, default=500)
    parser.add_argument("--pursuers", type=int, default=4, help="after two evaders")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    options.egos = tuple(options.egos)
    options.mates = tuple(options.mates)
    publish(options, study, page, draw)


if __name__ == "__main__":
    run_command(main)
