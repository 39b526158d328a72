"""Learning: rollout, advantages, MAPPO, predictor update, task archive and generator,
schedule, the compiled training step.
"""

from openjax.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "learners": "Experience Learner",
        "presets": "PRESETS changed preset",
        "settings": "AnalyticSettings GeneratorSettings MappoSettings TrainSettings",
        "training_step": "Parts TrainCarry build make_start make_training_step",
    },
)
