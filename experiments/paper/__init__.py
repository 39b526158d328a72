"""The paper's tables and figures, from the shipped weights and from training runs."""
