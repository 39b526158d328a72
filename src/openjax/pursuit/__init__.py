"""The game: tasks, evader, sensing, observation, reward, test layouts, and the
environment made of them.
"""

from openjax.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "environment": "Dynamics Observer Pursuit action_to_command hover_action make",
        "evaders.kinds": "EvaderKind",
        "info": "StepInfo",
        "observation": "Observation observe",
        "reward": "Term Transition default_reward",
        "scenarios": "SCENARIOS Scenario find_scenario scenario_task",
        "settings": "PursuitSettings RewardSettings",
        "state": "PursuitState",
        "statistics": "EpisodeStatistics",
        "task": (
            "Task close_starts empty_task expand_task line_up_pillars scatter_starts "
            "shift_pillars task_descriptor turn_task uniform_task"
        ),
    },
)
