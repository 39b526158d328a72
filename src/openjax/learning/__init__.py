"""Learning: rollout, advantages, MAPPO, predictor update, task archive and generator, the compiled training step."""

from openjax.learning.evaluation import EpisodeRecord, Evaluation, make_evaluate, summarise
from openjax.learning.settings import PRESETS, GeneratorSettings, MappoSettings, TrainSettings, preset
from openjax.learning.training_step import TrainCarry, abstract_carry, build, init_carry, make_training_step

__all__ = [
    "PRESETS",
    "EpisodeRecord",
    "Evaluation",
    "GeneratorSettings",
    "MappoSettings",
    "TrainCarry",
    "TrainSettings",
    "abstract_carry",
    "build",
    "init_carry",
    "make_evaluate",
    "make_training_step",
    "preset",
    "summarise",
]
