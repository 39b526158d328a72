"""The vocabulary of the exam: twenty effects, the forms and sizes that they are drawn in, and which
of them can stand in for one another.

How an effect acts is in `forces`, how a drawn cause gets into the plant's parameters in
`injection`.
"""

from typing import NamedTuple


class Drawn(NamedTuple):
    """What is drawn of an effect: (smallest, largest) size, forms, missions that expose it, logged
    channels that it needs.
    """

    sizes: tuple
    forms: tuple
    missions: tuple
    needs: str


SURFACE = ("inverse_square", "cheeseman_bennett", "exponential")
_EFFECTS = {
    "mass": ((0.02, 0.30), ("plain", "payload"), (), "m"),
    "thrust_scale": ((0.02, 0.22), ("plain", "thrust_only"), (), "m"),
    "battery_sag": (
        (0.10, 1.2),
        ("linear", "power", "quadratic", "load"),
        ("climb", "agile", "step"),
        "mv",
    ),
    "thrust_saturation": ((0.1, 0.95), ("hard", "voltage", "soft"), ("climb",), "m"),
    "rotor_drag": (
        (0.003, 0.035),
        ("linear", "quadratic", "rotor_speed", "raised_hub"),
        ("fast", "laps", "spiral"),
        "p",
    ),
    "blade_flapping": ((0.05, 3.0), ("linear", "advance_ratio"), ("fast", "agile", "laps"), "pg"),
    "wind": ((0.2, 12.0), ("steady", "quadratic", "shear", "gusty"), ("yaw", "fast", "hover"), "p"),
    "ground_effect": ((0.015, 0.35), SURFACE, ("low",), "pm"),
    "ceiling_effect": ((0.015, 0.35), SURFACE, ("high",), "pm"),
    "downwash": ((2.0, 20.0), ("gaussian", "jet"), ("pass", "pass_moving"), "pm"),
    "motor_lag": (
        (0.2, 3.5),
        ("slower", "up_down", "second_order", "brushed"),
        ("agile", "step"),
        "gm",
    ),
    "command_latency": (
        (4.0, 60.0),
        ("constant", "jitter", "spikes"),
        ("agile", "step", "yaw"),
        "gcm",
    ),
    "packet_loss": ((0.01, 0.5), ("independent", "bursts"), ("agile", "step", "yaw"), "gcm"),
    "thrust_curve": ((0.05, 1.0), ("quadratic", "power", "dip"), ("climb",), "m"),
    "motor_imbalance": ((0.003, 0.15), ("all", "one_weak"), (), "gm"),
    "com_offset": ((0.05, 8.0), ("torque", "full"), (), "gm"),
    "inertia": ((0.06, 0.6), ("diagonal", "products"), ("agile", "step", "yaw"), "gm"),
    "yaw_torque": ((0.06, 0.85), ("scale",), ("yaw",), "gm"),
    "rate_gains": ((0.08, 1.0), ("gains", "filtered_d"), ("agile", "step", "yaw"), "gcm"),
    "state_latency": ((4.0, 60.0), ("constant", "jitter"), ("agile", "fast", "step"), "pg"),
}
EFFECTS = {name: Drawn(*drawn) for name, drawn in _EFFECTS.items()}
# effects that can stand in for one another: not drawn together
FAMILIES = (
    ("mass", "thrust_scale", "battery_sag"),
    ("rotor_drag", "wind", "blade_flapping"),
    ("motor_imbalance", "com_offset"),
    ("inertia", "yaw_torque", "rate_gains"),
    ("thrust_curve", "thrust_saturation", "battery_sag"),
    ("command_latency", "packet_loss"),
)

# (effect, form) -> names that describe a part of it: no mistake beside its own
PARTS = {
    ("mass", "payload"): ("inertia",),
    ("rotor_drag", "raised_hub"): ("blade_flapping",),
    ("motor_imbalance", "one_weak"): ("thrust_scale", "mass"),
    ("command_latency", "spikes"): ("packet_loss",),
}


def draw(rng, effect, form=None):
    """A cause of the effect; the size lies within its usual range, the form is drawn unless given."""
    (low, high), forms = EFFECTS[effect].sizes, EFFECTS[effect].forms
    form = str(rng.choice(forms)) if form is None else form
    size = low * (high / low) ** rng.uniform()
    return {
        "effect": effect,
        "form": form,
        "size": float(size),
        "shape": rng.uniform(0, 1, 8).tolist(),
    }
