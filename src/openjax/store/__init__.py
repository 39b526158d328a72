"""What a run leaves on disk: its directory, settings, checkpoints and policies."""

DEFAULT_POLICY = "evaders"
"""The shipped policy that is taken wherever none is named."""
