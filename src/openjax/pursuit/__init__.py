"""The game: tasks, evader, sensing, observation, reward, test layouts, and the environment made of them."""

from openjax.pursuit.environment import Dynamics, Pursuit, action_to_command, hover_action, make
from openjax.pursuit.info import StepInfo
from openjax.pursuit.observation import Observation
from openjax.pursuit.scenarios import SCENARIOS, Scenario, find_scenario, scenario_settings, scenario_task
from openjax.pursuit.settings import PursuitSettings, RewardSettings
from openjax.pursuit.state import PursuitState
from openjax.pursuit.statistics import EpisodeStatistics
from openjax.pursuit.task import (
    Task,
    close_starts,
    empty_task,
    expand_task,
    line_up_pillars,
    shift_pillars,
    task_descriptor,
    turn_task,
    uniform_task,
)

__all__ = [
    "SCENARIOS",
    "Dynamics",
    "EpisodeStatistics",
    "Observation",
    "Pursuit",
    "PursuitSettings",
    "PursuitState",
    "RewardSettings",
    "Scenario",
    "StepInfo",
    "Task",
    "action_to_command",
    "close_starts",
    "empty_task",
    "expand_task",
    "find_scenario",
    "hover_action",
    "line_up_pillars",
    "make",
    "scenario_settings",
    "scenario_task",
    "shift_pillars",
    "task_descriptor",
    "turn_task",
    "uniform_task",
]
