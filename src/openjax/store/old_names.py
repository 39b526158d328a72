"""Settings as earlier versions wrote them: old policies and runs keep loading."""

import copy
from typing import Any

from openjax.learning import TrainSettings
from openjax.plain import from_plain

_RENAMED = {
    "validation_interval": "evaluation_interval",
    "validation_episodes": "evaluation_episodes",
    "mappo.clip_epsilon": "clip",
    "mappo.clip_epsilon_end": "clip_end",
    "mappo.entropy_coefficient": "entropy",
    "mappo.gae_lambda": "trace",
    "mappo.max_grad_norm": "gradient_norm",
    "mappo.value_norm_decay": "value_memory",
    "mappo.step_subsampling": "sample_every",
}
"""Where a setting is now, and its old name in the same group."""

_REMOVED = {
    "environment.observe_others_motion": False,
    "environment.reward.over_speed_after": 0.0,
    "evaders_start": 0.0,
}
"""Settings that are gone, with the only value that means what is done today."""


def train_settings(stored: Any, where: str) -> TrainSettings:
    """The settings of a run from what a file holds of them.

    Args:
      stored: plain values, under today's names or earlier ones.
      where: names the file in errors.

    Raises:
      UserError: an unknown setting, or a value that doesn't fit.
    """
    return from_plain(TrainSettings, _current_names(stored), where)


def _current_names(stored):
    if not isinstance(stored, dict):
        return stored
    current = copy.deepcopy(stored)
    for path, old in _RENAMED.items():
        group, name = _place(current, path)
        if old in group and name not in group:
            group[name] = group.pop(old)
    for path, value in _REMOVED.items():
        group, name = _place(current, path)
        if name in group and group[name] == value:
            del group[name]
    return current


def _place(settings, path):
    """The group (dict) and the last name of a setting with dots."""
    *groups, name = path.split(".")
    for group in groups:
        settings = settings.get(group, {})
        settings = settings if isinstance(settings, dict) else {}
    return settings, name
