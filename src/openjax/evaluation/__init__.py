"""Evaluation: whole episodes, validation tasks and scores. It knows nothing of how
anybody learned.
"""

from openjax.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "episodes": "EpisodeRecord Evaluation make_evaluate summarise",
        "evaluator": "Evaluator layout_slots layout_tasks",
        "result_tables": "record_of",
        "validation": "Validation selection_score uniform_tasks",
    },
)
