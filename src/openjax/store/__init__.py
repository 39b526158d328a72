"""What a run leaves on disk: its directory, settings, checkpoints and policies."""

DEFAULT_POLICY = "flight"
"""The shipped policy that is taken wherever none is named."""
