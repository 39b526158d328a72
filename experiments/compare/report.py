"""The measurements as Markdown, with what is and what isn't alike."""

from collections.abc import Iterable, Sequence

from experiments.pages import table

AIM = 5.0

ALIKE = """\
Every timed call is compiled beforehand (its time stands apart), warmed up once, repeated at least five times with the
same arguments and waited for with `block_until_ready`; the median counts. float32 everywhere, one device, no donation.
"""

DRONES = """\
One drone step is, in all columns, one step of {milliseconds:g} ms without substeps: rate controller, motors, rotor forces, one
semi-implicit Euler step of the rigid body ({steps} steps in one `lax.scan`, fewer for the largest `mjx`; constant
command). crazyflow: `Sim(control="body_rate", dynamics="first_principles", integrator="symplectic_euler", freq={frequency})`,
its default frequency, its own compiled `step`. Not the same task: `rigid` and `mjx` resolve contacts with floor, five
pillars and the other drones in each step, crazyflow clips at the floor and leaves contacts to a query that isn't timed, like
the columns that say "free"; crazyflow
models linear drag and the propellers' inertia, which our nominal vehicle leaves out; its Crazyflie is another model
(cf21B_500).
"""

GAMES = """\
JaxMARL's `simple_tag` moves points in a plane (three predators, one prey, two obstacles, 25 steps of 0.1 s) and resets
itself; our game moves three quadrotors among pillars with all of their dynamics, in steps of 10 ms. So the rows show
what each library makes one wait for, not the same work.
"""

TRAINING = """\
JaxMARL ships its MAPPO as a script outside the package; `experiments/compare/jaxmarl_mappo.py` writes the same update
(GRU actor and critic of 128, 128 steps, 4 epochs, 4 minibatches, all four agents learn). Ours: attention over entities,
predictor, task archive, 80 steps, 4 epochs, settings in compare.json's command. Environment steps per second of whole
training steps; agent steps are what the learner digests (four agents there, three here).
"""


def line(row: dict) -> str:
    """One measurement for the terminal."""
    name = f"{row['group']:11} {row['system']:9} {row['variant']:18} {row['worlds']:>9,} x {row['agents']}"
    if row["env_steps_per_second"] is None:
        return f"{name}: {_why(row)}"
    speed = _number(row["agent_steps_per_second"])
    return f"{name}: {speed} agent steps/s (compiled in {row['compile_seconds']:.1f} s)"


def markdown(facts: dict, rows: Sequence[dict]) -> str:
    """The whole page."""
    machine, versions = facts["machine"], facts["machine"]["versions"]
    named = ", ".join(
        f"{name} {versions[name]}" for name in ("jax", "crazyflow", "jaxmarl") if name in versions
    )
    lines = [
        "# openjax beside crazyflow and JaxMARL",
        "",
        f"`{facts['command']}` on {machine['device']}, {named}, Python {machine['python']}, commit {machine['commit']}, "
        f"{machine['date']}, {facts['seconds']:.0f} s in all.",
        "",
        ALIKE,
    ]
    if facts.get("peers"):
        peers = facts["peers"]
        lines += [
            f"crazyflow and JaxMARL weren't installed: their rows are those of `{peers['command']}` on {peers['device']}, "
            f"commit {peers['commit']}, {peers['date']}, made in the same way.",
            "",
        ]
    if facts["stand_ins"]:
        names = ", ".join(facts["stand_ins"])
        lines += [f"Not installed and replaced by empty modules, as nothing timed uses them: {names}.", ""]
    lines += ["## Drones", ""]
    lines.append(
        DRONES.format(
            milliseconds=1000 / facts["frequency"],
            steps=facts["settings"]["steps"],
            frequency=facts["frequency"],
        )
    )
    lines += drone_table(rows)
    lines += ["", *verdict(rows), "", "## Games", "", GAMES, *_plain_table(rows, "environment")]
    lines += ["", "## Training", "", TRAINING, *_plain_table(rows, "training")]
    lines += ["", "## Every measurement", "", *_everything(rows)]
    return "\n".join(lines) + "\n"


def drone_table(rows: Iterable[dict]) -> list[str]:
    """Drone steps per second by size: crazyflow, ours, and the ratio to crazyflow's body-rate control."""
    found = {(r["worlds"], r["agents"], r["variant"]): r for r in rows if r["group"] == "drones"}
    variants = [
        v for v in ("attitude", "rigid free", "rigid", "mjx free", "mjx") if any(key[2] == v for key in found)
    ]
    ours = [v for v in variants if v != "attitude"]
    heads = ["worlds", "drones each", "crazyflow body_rate"]
    heads += [f"crazyflow {v}" if v == "attitude" else v for v in variants]
    heads += [f"{v} / crazyflow" for v in ours]
    body = []
    for worlds, agents in sorted({key[:2] for key in found}, key=lambda size: (size[1], size[0])):
        at = {variant: found.get((worlds, agents, variant)) for variant in ("body_rate", *variants)}
        cells = [f"{worlds:,}", str(agents), *(_cell(row) for row in at.values())]
        cells += [_ratio(at[v], at["body_rate"]) for v in ours]
        body.append(cells)
    return table(heads, body)


def verdict(rows: Iterable[dict]) -> list[str]:
    """Where the aim over crazyflow's body-rate control is reached, missed, and where we are slower."""
    speeds = {
        (r["variant"], r["worlds"], r["agents"]): r["agent_steps_per_second"]
        for r in rows
        if r["group"] == "drones"
    }
    lines = []
    for variant in ("rigid free", "rigid", "mjx"):
        ratios = {}
        for (name, worlds, agents), speed in speeds.items():
            base = speeds.get(("body_rate", worlds, agents))
            if name == variant and speed and base:
                ratios[f"{worlds:,} x {agents}"] = speed / base
        if not ratios:
            continue
        missed = [f"{size} ({ratio:.2f})" for size, ratio in ratios.items() if ratio < AIM]
        slower = [size for size, ratio in ratios.items() if ratio < 1]
        lines.append(
            f"* `{variant}` is {min(ratios.values()):.2f} to {max(ratios.values()):.2f} times as fast as crazyflow's "
            f"body-rate control; the aim of {AIM:g} is "
            + (f"missed at {', '.join(missed)}." if missed else "reached everywhere.")
            + (f" Slower than crazyflow at {', '.join(slower)}." if slower else "")
        )
    return lines


def _plain_table(rows, group):
    body = []
    for row in rows:
        if row["group"] == group:
            agent_steps = row["agent_steps_per_second"]
            cells = [row["system"], row["variant"], f"{row['worlds']:,}", str(row["agents"])]
            body.append([*cells, _cell(row, "env"), "" if agent_steps is None else _number(agent_steps)])
    return table(["system", "what", "worlds", "agents", "environment steps/s", "agent steps/s"], body)


def _everything(rows):
    heads = ["group", "system", "what", "worlds", "agents", "steps per call", "calls", "median, ms"]
    heads += ["slowest, ms", "compilation, s", "memory of a call, MB"]
    body = []
    for row in rows:
        start = [row["group"], row["system"], row["variant"]]
        start += [f"{row['worlds']:,}", str(row["agents"]), str(row["steps"])]
        if row["env_steps_per_second"] is None:
            cells = ["", _why(row), "", "", ""]
        else:
            memory = row["memory"]
            cells = [str(row["calls"]), f"{1e3 * row['seconds']:.2f}", f"{1e3 * row['slowest']:.2f}"]
            cells += [f"{row['compile_seconds']:.1f}", "" if memory is None else f"{memory / 1e6:,.0f}"]
        body.append([*start, *cells])
    return table(heads, body)


def _cell(row, unit="agent"):
    if row is None:
        return ""
    speed = row[f"{unit}_steps_per_second"]
    return _why(row) if speed is None else _number(speed)


def _ratio(row, base):
    if not row or not base or not row["agent_steps_per_second"] or not base["agent_steps_per_second"]:
        return ""
    return f"{row['agent_steps_per_second'] / base['agent_steps_per_second']:.2f}"


def _why(row):
    if "skipped" in row:
        return f"not run: {row['skipped']}"
    return "failed: " + " ".join(row["failed"].split())[:120] if "failed" in row else "out of memory"


def _number(value):
    for unit, size in (("G", 1e9), ("M", 1e6), ("k", 1e3)):
        if value >= size:
            return f"{value / size:.3g} {unit}" if value < 1000 * size else f"{value / size:.0f} {unit}"
    return f"{value:.0f}"
