"""The files of a run: its directory, settings, checkpoints and policies."""

from openjax.pursuit.settings import PursuitSettings

DEFAULT_POLICY = "evaders"
"""The shipped policy that is taken wherever none is named, for the game that it knows:
three pursuers, one speed of the evader, one capture radius, one arena.
"""
TEAM_POLICY = "teams"
"""The one for any other, which it observes."""
_OF_THE_GAME = ("num_pursuers", "evader_speed", "capture_radius", "arena_radius")


def default_policy(game: PursuitSettings) -> tuple[str, str]:
    """The shipped policy that flies a game where none is named, and what is said of it;
    nothing of the usual one.
    """
    usual = PursuitSettings()
    constants = [
        f"{name} {getattr(usual, name):g}"
        for name in _OF_THE_GAME
        if getattr(game, name) != getattr(usual, name)
    ]
    if not constants:
        return DEFAULT_POLICY, ""
    line = f"policy {TEAM_POLICY}: {DEFAULT_POLICY} knows only {', '.join(constants)}"
    return TEAM_POLICY, line
