"""Evaders as data: what each does, which numbers are drawn for it in each world, and which of them
may be trained on.
"""

from openjax.lazy import lazy_names

# loaded when asked for: the game's settings need the names alone
__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "evader": "EvaderState draw_evader evader_velocity scene_of",
        "field": "field_velocity",
        "kinds": "EVADERS HELD_OUT SCRIPTED TRAINED VALIDATED EvaderKind check_evaders",
        "learned": "init_network learned_place",
    },
)
