"""What a run leaves on disk: its directory, settings, checkpoints and policies."""

from openjax.pursuit.settings import LAYOUT_PURSUERS

DEFAULT_POLICY = "evaders"
"""The shipped policy that is taken wherever none is named, for three pursuers."""
TEAM_POLICY = "teams"
"""The one for any other number of them."""


def default_policy(num_pursuers: int) -> tuple[str, str]:
    """The shipped policy that so many pursuers fly where none is named, and what is
    said of it; nothing of the usual one.
    """
    if num_pursuers == LAYOUT_PURSUERS:
        return DEFAULT_POLICY, ""
    line = (
        f"policy {TEAM_POLICY}: {DEFAULT_POLICY} flies {LAYOUT_PURSUERS} pursuers only"
    )
    return TEAM_POLICY, line
