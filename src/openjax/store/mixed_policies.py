"""Several loaded policies as one that draws, and one of them by itself again."""

import dataclasses
from collections.abc import Sequence

import jax

from openjax.errors import UserError
from openjax.learning import TrainSettings
from openjax.plain import from_plain
from openjax.policy import MixedPolicy, mixed_parameters
from openjax.policy.growth import in_larger_game
from openjax.pursuit import Pursuit, PursuitSettings
from openjax.store.policies import LoadedPolicy
from openjax.store.policy_files import WEIGHTS, load_policy_file, shipped_policies
from openjax.store.run_directory import RunDirectory, is_run


@dataclasses.dataclass(frozen=True)
class Draws:
    """The way in which a team draws one of its policies."""

    seconds: float = 0.4
    """Time after which it draws again (s); 0: it draws once an episode."""
    odds: tuple[float, ...] = ()
    """Of each policy, in any unit; empty: all have the same."""
    odds_unseen: tuple[float, ...] = ()
    """The same while nobody sees the evader; empty: as while somebody does."""


def mixed_policy(policies: Sequence[LoadedPolicy], draws: Draws) -> LoadedPolicy:
    """A team that draws one of K policies at the start, and again and again. One that
    draws already stands for its members.

    Its game is the first one's, in which pursuers observe all that any of the policies
    does. Critics are left out: flying needs none.

    Raises:
      UserError: fewer than two, or policies of different networks or axes.
    """
    policies = [
        member(policy, place)
        for policy in policies
        for place in range(policy.settings.environment.strategies)
    ]
    if len(policies) < 2:
        raise UserError("a team needs two policies or more to switch among")
    first = policies[0]
    game = common_game([policy.settings.environment for policy in policies])
    environment = Pursuit(game)
    for policy in policies:
        if policy.is_heuristic or not policy.parameters.actor:
            raise UserError(
                f"policy {policy.source} has no networks: it can't be a member of a team"
            )
        for part in ("network", "predictor"):
            if getattr(policy.settings, part) != getattr(first.settings, part):
                raise UserError(
                    f"policies {first.source} and {policy.source} differ in {part}; members of "
                    "one team must have the same networks"
                )
    members = [_in_game(policy, environment) for policy in policies]
    settings = dataclasses.replace(first.settings, environment=game)
    return LoadedPolicy(
        MixedPolicy(first.policy, len(policies)),
        mixed_parameters([policy.parameters.replace(critic={}) for policy in members]),
        with_strategies(settings, len(policies), draws),
        " + ".join(policy.source for policy in policies),
    )


def common_game(games: Sequence[PursuitSettings]) -> PursuitSettings:
    """The first of some games, in which pursuers observe all that they do in any."""
    first = games[0]
    kinds = {game.history_pursuers for game in games}
    choices = ("observe_position", "observe_game", "observe_arena")
    return dataclasses.replace(
        first,
        observe_history=max(game.observe_history for game in games),
        history_pursuers=kinds.pop() if len(kinds) == 1 else "both",
        **{name: any(getattr(game, name) for game in games) for name in choices},
    )


def _in_game(policy, environment):
    """A policy that acts in a larger game as it did in its own."""
    if not environment.settings.team_sizes:
        policy = policy.of_team(environment.settings.num_pursuers)
    settings = policy.settings
    parameters = in_larger_game(
        policy.parameters, settings.predictor, settings.environment, environment.settings
    )
    game = settings.environment
    names = ("observe_history", "history_pursuers", "observe_position", "observe_game")
    for name in (*names, "observe_arena"):
        game = dataclasses.replace(game, **{name: getattr(environment.settings, name)})
    settings = dataclasses.replace(settings, environment=game)
    return dataclasses.replace(policy, parameters=parameters, settings=settings).in_game(
        environment
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
        with_strategies(policy.settings, 1, Draws(0.0)),
        f"{policy.source}, member {place}",
    )


def with_strategies(settings: TrainSettings, strategies: int, draws: Draws) -> TrainSettings:
    """The settings of a policy's file for a team that draws one of so many
    `strategies`.
    """
    game = dataclasses.replace(
        settings.environment,
        strategies=strategies,
        strategy_seconds=draws.seconds,
        strategy_odds=draws.odds,
        strategy_odds_unseen=draws.odds_unseen,
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
