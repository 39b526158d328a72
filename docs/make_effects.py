"""Pictures of the effects from their own code, `python docs/make_effects.py`, and the
text of their page, which the site's build writes.

Each kind of hook has its picture: what becomes of a command, of a pose, of a motor
command, of a rotor's thrust, of the wrench, or of a manoeuvre where the vehicle itself
is another one. Grey is the nominal vehicle; parameters are usual ones.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from openjax.vehicle import hover_state, load_vehicle, make_drones_step
from openjax.vehicle.arena import Arena
from openjax.vehicle.effects import EFFECTS, make_context
from openjax.vehicle.effects.effect import Effect
from openjax.vehicle.parameters import max_rotor_thrust

DOCS = Path(__file__).parent
PICTURES = DOCS / "pictures" / "effects"
DT = 0.002  # s
COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:red")
GREY = {"color": "0.6", "linewidth": 3.5}
VEHICLE = load_vehicle()
HOVER = float(VEHICLE.mass * VEHICLE.gravity / (4 * max_rotor_thrust(VEHICLE)))


def usual(effect: Effect) -> dict:
    """Parameters at which the effect acts, as arrays; where they may have either sign,
    every second one has the other.
    """
    values = {}
    for i, (name, what) in enumerate(effect.parameters.items()):
        low, high = what.prior
        both = np.isclose(low + high, 2 * what.none)
        values[name] = jnp.float32(low + (0.3 if both and i % 2 else 0.75) * (high - low))
    return values


def state_at(position=(0.0, 0.0, 0.6), velocity=(0.0, 0.0, 0.0)):
    """One hovering drone."""
    drones = hover_state(
        VEHICLE,
        jnp.array([position], jnp.float32),
        velocity=jnp.array([velocity], jnp.float32),
    )
    return jax.tree.map(lambda leaf: leaf[0], drones)


def draw_command(effect, axes):
    """A command that steps, as sent and as it arrives."""
    time = np.arange(0.0, 0.6, 0.01)
    sent = np.where((time > 0.1) & (time < 0.3), 2.0, 0.0) + np.where(
        time > 0.3, 1.5 * np.sin(20 * (time - 0.3)), 0
    )
    state = state_at()
    arrived = []
    memory = effect.initial_memory(VEHICLE, state, 0.01, jax.random.key(1))
    context = make_context(VEHICLE, state, dt=0.01)
    for rate in sent:
        command, memory = effect.command(
            usual(effect), memory, jnp.array([HOVER, rate, 0, 0], jnp.float32), context
        )
        arrived.append(float(command[1]))
    axes.step(time, sent, where="post", label="sent", **GREY)
    axes.step(time, arrived, where="post", color=COLOURS[0], label="arrives")
    axes.set(xlabel="time [s]", ylabel="roll rate command [rad/s]")


def draw_sensor(effect, axes):
    """A path, as flown and as the controller sees it."""
    time = np.arange(0.0, 0.6, 0.01)
    path = 0.1 * np.sin(10 * time)
    state = state_at((path[0], 0.0, 0.6))
    seen = []
    memory = effect.initial_memory(VEHICLE, state, 0.01, jax.random.key(1))
    for x in path:
        state = state_at((x, 0.0, 0.6))
        seen.append(float(effect.sensor(usual(effect), memory, state).position[0]))
        memory = effect.record(memory, state)
    axes.plot(time, 100 * path, label="flown", **GREY)
    axes.plot(time, 100 * np.array(seen), color=COLOURS[0], label="seen")
    axes.set(xlabel="time [s]", ylabel="x [cm]")


def draw_motor(effect, axes):
    """The motor command that takes effect, at three voltages where they matter."""
    commands = np.linspace(0.0, 1.0, 101)
    axes.plot(commands, commands, label="nominal", **GREY)
    lines = {}
    for voltage in (4.1, 3.7, 3.3):
        context = make_context(VEHICLE, state_at(), battery_voltage=voltage)
        lines[voltage] = jax.vmap(
            lambda m, c=context: effect.motor(usual(effect), jnp.full(4, m), c)[0]
        )(commands)
    same = all(np.allclose(line, lines[3.7], atol=1e-6) for line in lines.values())
    for (voltage, line), colour in zip(lines.items(), COLOURS, strict=False):
        if not same or voltage == 3.7:
            axes.plot(
                commands,
                line,
                color=colour,
                label="with the effect" if same else f"{voltage} V",
            )
    axes.set(xlabel="motor command", ylabel="takes effect as")


def draw_thrust(effect, axes):
    """Each rotor's thrust over its nominal one, from the floor to the ceiling."""
    heights = np.linspace(0.03, Arena.height - 0.03, 60)

    def factors(z):
        state = state_at((0.0, 0.0, z))
        context = make_context(VEHICLE, state)
        return (
            effect.thrust(usual(effect), context.thrust, 0 * context.thrust, context)[0]
            / context.thrust
        )

    found = np.stack([np.asarray(factors(z)) for z in heights])
    axes.axhline(1.0, label="nominal", **GREY)
    alike = np.allclose(found, found[:, :1], atol=1e-6)
    for rotor in range(1 if alike else 4):
        axes.plot(
            heights,
            found[:, rotor],
            color=COLOURS[rotor],
            label="each rotor" if alike else f"rotor {rotor + 1}",
        )
    axes.set(xlabel="height [m]", ylabel="thrust / nominal")


def draw_wrench(effect, axes):
    """Force against forward speed; where speed doesn't matter, against the place of a
    vehicle above.
    """

    def force(speed, offset):
        state = state_at(velocity=(speed, 0.0, 0.0))
        other = jnp.array([[offset, 0.0, 1.0]], jnp.float32)
        return np.asarray(
            effect.wrench(usual(effect), make_context(VEHICLE, state, others_position=other))[0]
        )

    speeds = np.linspace(-1.5, 1.5, 31)
    offsets = np.linspace(-0.4, 0.4, 41)
    along = np.stack([force(speed, 9.0) for speed in speeds])
    if np.ptp(along, axis=0).max() > 1e-9:
        grid = speeds
        found = along
        label = "forward speed [m/s]"
    else:
        grid = offsets
        label = "place of a vehicle .4 m above, to the side [m]"
        found = np.stack([force(0.0, offset) for offset in offsets])
    axes.axhline(0.0, label="nominal", **GREY)
    for axis, colour in zip(range(3), COLOURS, strict=False):
        if np.abs(found[:, axis]).max() > 1e-6:
            axes.plot(grid, 1000 * found[:, axis], color=colour, label=f"body {'xyz'[axis]}")
    axes.set(xlabel=label, ylabel="force [mN]")


def draw_body(effect, axes):
    """Answer of the vehicle to steps of roll rate, yaw rate and thrust; what differs
    most is drawn.
    """
    time = np.arange(0.0, 0.8, DT)
    commands = np.zeros((len(time), 1, 4), np.float32)
    commands[:, 0, 0] = HOVER * np.where(time > 0.55, 1.25, 1.0)
    commands[:, 0, 1] = np.where((time > 0.05) & (time < 0.2), 3.0, 0.0) - np.where(
        (time > 0.2) & (time < 0.35), 3.0, 0.0
    )
    commands[:, 0, 3] = np.where((time > 0.3) & (time < 0.5), 2.0, 0.0)
    answers = [
        _flown(names, parameters, commands)
        for names, parameters in (
            ((), {}),
            ((effect.name,), {effect.name: usual(effect)}),
        )
    ]
    scale = {
        "roll rate [rad/s]": 3.0,
        "yaw rate [rad/s]": 2.0,
        "vertical speed [m/s]": 0.3,
    }
    most = max(
        scale,
        key=lambda name: np.abs(answers[1][name] - answers[0][name]).max() / scale[name],
    )
    axes.plot(time, answers[0][most], label="nominal", **GREY)
    axes.plot(time, answers[1][most], color=COLOURS[0], label="with the effect")
    axes.set(xlabel="time [s]", ylabel=most)


def _flown(names, parameters, commands):
    step = make_drones_step(physics="rigid", dt=DT, substeps=1, contacts=False, effects=names)
    drones = hover_state(VEHICLE, jnp.array([[0.0, 0.0, 0.6]], jnp.float32))
    drones = step.reset(VEHICLE, drones, jax.random.key(0))

    def one(drones, command):
        drones = step(VEHICLE, drones, command, jnp.zeros((0, 2)), jnp.zeros(0, bool), parameters)
        return drones, (drones.body_rates[0], drones.velocity[0])

    _, (rates, velocity) = jax.lax.scan(one, drones, jnp.asarray(commands))
    return {
        "roll rate [rad/s]": np.asarray(rates[:, 0]),
        "yaw rate [rad/s]": np.asarray(rates[:, 2]),
        "vertical speed [m/s]": np.asarray(velocity[:, 2]),
    }


DRAWN = {"command": draw_command, "sensor": draw_sensor, "motor": draw_motor, "thrust": draw_thrust,
         "body": draw_body, "wrench": draw_wrench}  # fmt: skip
"""Hook of an effect, and what draws it."""


def draw(effect: Effect, path: Path) -> None:
    """Write the picture of an effect."""
    figure = Figure(figsize=(4.6, 2.5), layout="constrained")
    axes = figure.subplots()
    next(function for hook, function in DRAWN.items() if getattr(effect, hook) is not None)(
        effect, axes
    )
    axes.legend(fontsize="small", frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def page() -> str:
    """The page's text."""
    lines = [
        f"# The {len(EFFECTS)} effects",
        "",
        "Each effect is one file in `src/openjax/vehicle/effects` and serves twice: `openjax train",
        "--effects effects.toml` flies with it, and `openjax diagnose` fits it. The pictures come from",
        "that code with usual parameters; grey is the nominal vehicle. Below a picture are the usual",
        "ranges of the parameters, and their sources.",
        "",
        "$m$ is a motor command, $T_i$ and $Q_i$ are thrust and reaction torque of rotor $i$, $v_i$ is the",
        "velocity of its hub through the air in the body frame, $R$ the propeller radius, $z_i$ its height,",
        "$u$ the command of thrust and body rates, $V$ the battery voltage.",
    ]
    for name, effect in EFFECTS.items():
        module = __import__(f"openjax.vehicle.effects.{name}", fromlist=["EFFECT"])
        sentence = " ".join(module.__doc__.split("\n\n")[0].split())
        lines += ["", f"## {name}", "", sentence, "", f"$${effect.formula}$$", ""]
        lines += [f"![{name}](../pictures/effects/{name}.png)", ""]
        for parameter, what in effect.parameters.items():
            meaning = f" ({what.meaning})" if what.meaning else ""
            unit = "" if what.unit == "1" else f" {what.unit}"
            lines.append(f"* `{parameter}`{meaning}: {what.prior[0]:g} to {what.prior[1]:g}{unit}")
        sources = dict.fromkeys(what.source for what in effect.parameters.values())
        lines += ["", f"*{'; '.join(sources)}.*"]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Draw all pictures."""
    PICTURES.mkdir(parents=True, exist_ok=True)
    for name, effect in EFFECTS.items():
        draw(effect, PICTURES / f"{name}.png")


if __name__ == "__main__":
    main()
