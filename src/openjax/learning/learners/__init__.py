"""Learners: what learns from a rollout in the training step. Shipped are MAPPO for the
pursuers' policy, the supervised evader predictor, and PPO for evaders that learn beside
them; anything with `start` and `learn` may stand in their place or beside them
(`learner.py`).
"""

from openjax.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "evasion": "EvaderLearner",
        "learner": "Experience Learner",
        "mappo": "Mappo",
        "predictor_update": "PredictorLearner",
    },
)
