"""From flights to a better policy: `openjax adapt FLIGHTS --policy NAME --out DIR`.

Diagnoses the flights, draws vehicles from the intervals of what was found, fine-tunes the policy on
them by the gradient through the simulation, and measures both policies on tasks and vehicles that
neither was trained on. Writes DIR/policy.npz, adapt.json and adapt.html.
"""

import dataclasses
from collections.abc import Sequence

from openjax.command_line import output_console, parse
from openjax.commands.options import AdaptCommand
from openjax.errors import UserError
from openjax.files import check_output_folder
from openjax.show.progress import Steps
from openjax.store.compiled_programs import cache_programs


def main(arguments: Sequence[str]) -> int:
    """The command; returns its exit status. Raises UserError where there are no
    flights, or none that can be used.
    """
    command = parse(AdaptCommand, AdaptCommand(), arguments, "openjax adapt")
    if not command.flights.exists():
        raise UserError(f"{command.flights}: no such folder of flights, and no such effects.toml")
    check_output_folder(command.out, "--out")
    if command.out.exists() and not command.overwrite:
        raise UserError(f"{command.out} already exists: choose another --out or give --overwrite")
    if command.compilation_cache:
        cache_programs()
    import jax

    from openjax.commands.adapt_policy import ON_CPU, STEPS, adapt, check
    from openjax.commands.adapt_report import in_words

    console = output_console()
    on_cpu = jax.default_backend() == "cpu"
    command = dataclasses.replace(command, episodes=command.episodes or (128 if on_cpu else 1024))
    check(command)
    with Steps(f"adapting {command.policy}", ON_CPU if on_cpu else STEPS, console) as steps:
        results = adapt(command, steps.begin)
    for line in in_words(results):
        console.print(line, soft_wrap=True)
    console.print(f"policy, figures and page are in {command.out}", soft_wrap=True)
    return 0
