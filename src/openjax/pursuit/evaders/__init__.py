"""Evaders as data: what each does, which numbers are drawn for it in each world, and
which of them may be trained on.
"""

from openjax.lazy import lazy_names

# loaded when asked for: the game's settings need the names alone
__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "behaviours": "Scene",
        "evader": "draw_evader draw_row evader_velocity scene_of",
        "evader_state": "EvaderState",
        "field": "field_velocity",
        "kinds": (
            "EVADERS HELD_OUT SCRIPTED VALIDATED Evader EvaderKind check_evaders evader_rows "
            "handed_in"
        ),
        "learned": "init_network learned_place",
    },
)
