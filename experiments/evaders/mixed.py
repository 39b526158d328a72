"""One policy of several: a team that draws which of them it flies.

python -m experiments.evaders.mixed a.npz b.npz c.npz --out mixed.npz [--seconds 1]
"""

import argparse
import dataclasses
from pathlib import Path

from openjax.policy import mixed_parameters
from openjax.store.policies import load_policy
from openjax.store.policy_files import save_policy_file


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policies", nargs="+", help="names or files")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--seconds", type=float, default=0.0, help="between two draws; 0: one a flight"
    )
    command = parser.parse_args()
    members = [load_policy(name) for name in command.policies]
    settings = members[0].settings
    game = dataclasses.replace(
        settings.environment,
        strategies=len(members),
        strategy_seconds=command.seconds,
    )
    # the critic isn't needed in flight, and shipped policies have none
    parameters = mixed_parameters(
        [member.parameters.replace(critic={}) for member in members]
    )
    settings = dataclasses.replace(settings, environment=game)
    save_policy_file(command.out, parameters, settings, {"members": command.policies})


if __name__ == "__main__":
    main()
