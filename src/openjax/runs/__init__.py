"""A training run. `request` reads what `train_command` offers; `start` makes the run's directory
and its `job`; `training` makes the `programs` and takes them through the `stages`: first flights,
the `loop` of updates, the last stage. `report` ends it.
"""
