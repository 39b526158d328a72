"""Tuning of the diagnosis' decision on the withheld plant's tuning seeds."""
