"""Learning: rollout, advantages, MAPPO, predictor update, task archive and generator, schedule, the compiled training step."""

from openjax.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        **dict.fromkeys(("EpisodeRecord", "Evaluation", "make_evaluate", "summarise"), "evaluation"),
        **dict.fromkeys(
            ("AnalyticSettings", "GeneratorSettings", "MappoSettings", "TrainSettings"), "settings"
        ),
        **dict.fromkeys(("PRESETS", "changed", "preset"), "presets"),
        **dict.fromkeys(
            ("TrainCarry", "build", "make_start", "make_training_step"),
            "training_step",
        ),
    },
)
