"""Evaders as data: what each does, which numbers are drawn for it in each world, and which of them may be trained on."""

from openjax.lazy import lazy_names

# loaded when asked for: the game's settings need the names alone
_HOMES = {
    "EVADERS": "kinds",
    "HELD_OUT": "kinds",
    "SCRIPTED": "kinds",
    "TRAINED": "kinds",
    "VALIDATED": "kinds",
    "EvaderKind": "kinds",
    "EvaderState": "evader",
    "check_evaders": "kinds",
    "draw_evader": "evader",
    "evader_velocity": "evader",
    "field_velocity": "field",
    "init_network": "learned",
    "learned_place": "learned",
    "scene_of": "evader",
}
__getattr__, __dir__, __all__ = lazy_names(__name__, _HOMES)
