"""Everything of a run that touches a file, a clock or a terminal: checkpoints, metrics, display, pictures."""
