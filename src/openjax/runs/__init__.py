"""The host's side of a training run, and what the longer commands do."""
