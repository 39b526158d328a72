"""Every command of the package: `openjax NAME ...`, or `python -m openjax NAME ...`."""

import importlib
import os
import sys
from collections.abc import Sequence

from openjax import interruption
from openjax.errors import UserError, suggestion
from openjax.version import __version__

COMMANDS = {
    "train": "train pursuers, or continue a run",
    "evaluate": "fly policies on layouts: captures, collisions, crashes",
    "view": "watch episodes in three dimensions, in a browser or as an HTML file",
    "play": "be the evader, in a browser, against a policy",
    "exploit": "train an evader against a policy, and see how well the policy holds",
    "mix": "make one team that switches among several policies",
    "map": "show what a policy catches, over team sizes, speeds and capture radii",
    "sample_flights": "write logs of a simulated vehicle with an effect, to try the diagnosis on",
    "diagnose": "name the causes of the sim-to-real gap, or what changed, from flight logs",
    "plan": "find the flight that tells a diagnosis' causes apart, and write its set-points",
    "calibrate": "fit thrust, torque, motor lag and inertia of the nominal vehicle to flights",
    "adapt": "diagnose flights and fine-tune a policy to the vehicle that flew them",
    "fly": "fly a policy on Crazyflies, virtual or real",
    "virtual_crazyflie": "simulate Crazyflies that answer as real ones do",
    "export": "write a policy as ONNX, jax.export or C99",
    "benchmark": "measure steps per second on this machine",
}
"""What each does; the module of the same name in `openjax.commands` holds its
`main(arguments)`.
"""


def usage() -> str:
    """The help text."""
    width = max(map(len, COMMANDS))
    rows = "\n".join(f"  {name:{width}}  {text}" for name, text in COMMANDS.items())
    return (
        "usage: openjax COMMAND [OPTIONS]      (openjax COMMAND --help says more)\n\n"
        f"{rows}\n\n"
        "Pursuit-evasion of quadrotors in JAX, and a diagnosis of the sim-to-real gap.\n"
        "First: openjax view, openjax train, openjax sample_flights my_flights --effect rotor_drag"
    )


def main(arguments: Sequence[str]) -> int | None:
    """Run the command that the first argument names; returns its exit status. Raises
    UserError for an unknown one.
    """
    name = arguments[0] if arguments else "--help"
    if name in ("-h", "--help", "help"):
        print(usage())
        return 0
    if name in ("-V", "--version"):
        print(f"openjax {__version__}")
        return 0
    command = name.replace("-", "_")
    if command not in COMMANDS:
        raise UserError(f"{name}: no such command; {suggestion(command, COMMANDS)}")
    # as JAX reads it, which needn't be loaded for that
    if os.environ.get("JAX_ENABLE_X64", "").lower() in ("1", "t", "true", "y", "yes", "on"):
        raise UserError("JAX_ENABLE_X64 is set; openjax computes in 32 bits: unset it")
    return importlib.import_module(f"openjax.commands.{command}").main(arguments[1:])


def entry(*command: str) -> None:
    """Run the installed script `openjax`; with a command's name, the same as `python -m
    openjax.NAME`.
    """
    interruption.install()
    from openjax.command_line import run_command  # takes its time, so only now

    run_command(lambda arguments: main([*command, *arguments]))


if __name__ == "__main__":
    sys.argv[0] = "openjax"
    entry()
