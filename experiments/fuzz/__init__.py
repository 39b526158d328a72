"""Hostile input, damaged checkpoints, kills at any instant, and what openjax makes of them."""
