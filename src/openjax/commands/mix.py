"""`openjax mix POLICY POLICY ...`: one policy of several, a team that draws which of
them it flies.
"""

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from openjax.command_line import output_console, parse
from openjax.errors import UserError
from openjax.files import check_output
from openjax.ranges import Interval, check_intervals

PROGRAM = "openjax mix"


@dataclass(frozen=True)
class MixCommand:
    """Make one policy of several: the team draws which of them it flies, and the evader
    isn't told (a mixed strategy).

    All must have learned with the same networks. What only some of them observed, the
    others don't mind.
    """

    policies: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Two or more: names, files, or runs' directories; one that draws already stands for
    its members."""
    seconds: Annotated[float, Interval("[0, 1000]")] = 0.4
    """Time after which the team draws again (s); 0: it draws once an episode. By
    default sooner than a trap is closed.
    """
    odds: tuple[float, ...] = ()
    """Odds of each policy, in any unit; by default all have the same."""
    odds_unseen: tuple[float, ...] = ()
    """The same while nobody sees the evader; by default as while somebody does."""
    out: Path = Path("mixed.npz")
    """File to write the policy to."""

    def __post_init__(self):
        check_intervals(self, "")


def main(arguments: Sequence[str]) -> None:
    """The command. Raises UserError for policies that don't fit together."""
    options = parse(MixCommand, MixCommand(policies=tyro.MISSING), arguments, PROGRAM)
    check_output(options.out, "--out")
    if options.out.suffix != ".npz":
        raise UserError(f"--out {options.out}: a policy's file ends in .npz")
    from openjax.store.mixed_policies import (
        Draws,
        as_trained,
        common_game,
        mixed_policy,
        with_strategies,
    )
    from openjax.store.policies import load_policy
    from openjax.store.policy_files import save_policy_file

    draws = Draws(options.seconds, options.odds, options.odds_unseen)
    policy = mixed_policy([load_policy(name) for name in options.policies], draws)
    files = [as_trained(name) for name in options.policies]
    game = common_game([settings.environment for settings, _ in files])
    settings = dataclasses.replace(files[0][0], environment=game)
    number = policy.policy.number
    members = [
        {"policy": name, **notes} for name, (_, notes) in zip(options.policies, files, strict=True)
    ]
    save_policy_file(
        options.out,
        policy.parameters,
        with_strategies(settings, number, draws),
        {"members": members},
    )
    console = output_console()
    console.print(
        f"{options.out}: switches at random among {number} policies "
        + (f"every {options.seconds:g} s" if options.seconds else "for each episode"),
        soft_wrap=True,
    )
    console.print(f"how well it holds: openjax exploit --policy {options.out}", soft_wrap=True)
