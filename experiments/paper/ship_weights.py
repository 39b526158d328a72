"""Put trained policies into the package, without their critics: `python -m
experiments.paper.ship_weights NAME=RUN ...`.
"""

from pathlib import Path

from openjax.command_line import run_command
from openjax.store.policies import load_policy
from openjax.store.policy_files import WEIGHTS, load_policy_file, save_policy_file


def main(arguments: list[str]) -> None:
    """Write one file per NAME=RUN; RUN is a run's directory or a policy file."""
    for argument in arguments:
        name, _, source = argument.partition("=")
        path = Path(source)
        _, settings, notes = load_policy_file(path / "policy.npz" if path.is_dir() else path)
        target = WEIGHTS / f"{name}.npz"
        save_policy_file(target, load_policy(source).parameters.replace(critic={}), settings, notes)
        print(f"{target.name}: {target.stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    run_command(main)
