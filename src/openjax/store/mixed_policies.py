"""Several loaded policies as one that draws, and one of them by itself again."""

import dataclasses
from collections.abc import Sequence

import jax

from openjax.errors import UserError
from openjax.learning import TrainSettings
from openjax.plain import from_plain
from openjax.policy import MixedPolicy, mixed_parameters
from openjax.pursuit import Pursuit
from openjax.store.policies import LoadedPolicy
from openjax.store.policy_files import WEIGHTS, load_policy_file, shipped_policies
from openjax.store.run_directory import RunDirectory, is_run


def mixed_policy(policies: Sequence[LoadedPolicy], seconds: float) -> LoadedPolicy:
    """A team that draws one of K policies at the start, and again after each `seconds`
    (s; 0: never).

    Its game is the first one's. Critics are left out: flying needs none.

    Raises:
      UserError: fewer than two, one that draws already, or policies of different
      networks or observations.
    """
    if len(policies) < 2:
        raise UserError("a team that draws needs two policies or more to draw from")
    first = policies[0]
    environment = Pursuit(first.settings.environment)
    for policy in policies:
        if policy.is_heuristic or not policy.parameters.actor:
            raise UserError(f"policy {policy.source} has no networks to be drawn")
        if isinstance(policy.policy, MixedPolicy):
            raise UserError(f"policy {policy.source} draws already; name its members")
        for part in ("network", "predictor"):
            if getattr(policy.settings, part) != getattr(first.settings, part):
                raise UserError(
                    f"policies {first.source} and {policy.source} differ in {part}; members of "
                    "one team must have the same networks"
                )
        policy.in_game(environment)
    return LoadedPolicy(
        MixedPolicy(first.policy, len(policies)),
        mixed_parameters([policy.parameters.replace(critic={}) for policy in policies]),
        with_strategies(first.settings, len(policies), seconds),
        " + ".join(policy.source for policy in policies),
    )


def member(policy: LoadedPolicy, place: int) -> LoadedPolicy:
    """One of the policies that a team draws from, by itself; the policy as it is where
    nothing is drawn.
    """
    if not isinstance(policy.policy, MixedPolicy):
        return policy
    return LoadedPolicy(
        policy.policy.member,
        jax.tree.map(lambda leaf: leaf[place], policy.parameters),
        with_strategies(policy.settings, 1, 0.0),
        f"{policy.source}, member {place}",
    )


def with_strategies(settings: TrainSettings, strategies: int, seconds: float) -> TrainSettings:
    """The settings of a policy's file for a team that draws one of so many `strategies`
    every `seconds` (s; 0: once an episode).
    """
    game = dataclasses.replace(
        settings.environment, strategies=strategies, strategy_seconds=seconds
    )
    return dataclasses.replace(settings, environment=game)


def as_trained(name: str) -> tuple[TrainSettings, dict]:
    """The settings of a policy as its file has them, which loading fits to the machine,
    and what the file says of its training.
    """
    if name in shipped_policies():
        path = WEIGHTS / f"{name}.npz"
    else:
        path = RunDirectory(name).policy if is_run(name) else name
    _, settings, notes = load_policy_file(path)
    return from_plain(TrainSettings, settings, f"{path}: "), notes
