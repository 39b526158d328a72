"""What a run leaves on disk: its directory, settings, checkpoints and policies."""
