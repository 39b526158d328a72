"""Motors follow their commands more slowly than assumed; spin-up isn't spin-down."""

import jax.numpy as jnp
import numpy as np

from openjax.vehicle.effects.effect import Card, Effect, Fitted, Nuisance, Parameter

_SHORTEST = 1e-3  # s
# small brushed motors were measured at up to 0.1 s in all, and no loop flies through
# more; a rotor that nothing but the air slows down takes longer for that, and a vehicle
# flies all the same
_SLOWEST = 0.1  # s
_SLOWEST_DOWN = 0.25  # s
# motors that seem earlier than this are not what they seem
EARLY = 0.0025  # s


def body(parameters, vehicle):
    """Both time constants; the vehicle holds the first, and the ratio of the second to it."""
    up = jnp.maximum(vehicle.motor_time_constant + parameters["extra_up"], _SHORTEST)
    down = vehicle.motor_time_constant * vehicle.motor_slowdown_ratio + parameters["extra_down"]
    return vehicle.replace(
        motor_time_constant=up, motor_slowdown_ratio=jnp.maximum(down, _SHORTEST) / up
    )


def lags(value, deviation):
    """True if motors lag. That they are early is what gusts look like, which the rate
    controller answers, and single samples of the motors; a motor's time constant is
    known better than that.
    """
    if not -EARLY < max(value["extra_up"], value["extra_down"]):
        return False
    return value["extra_up"] < _SLOWEST and value["extra_down"] < _SLOWEST_DOWN


def spin_up_error(vehicle):
    """s: motors of a kind differ by some per cent."""
    return 0.05 * vehicle.motor_time_constant


def spin_down_error(vehicle):
    """s: braking isn't driving; brushed motors were measured up to a third slower down
    than up.
    """
    return 0.15 * vehicle.motor_time_constant * vehicle.motor_slowdown_ratio


def up(vehicle):
    """s: a time constant isn't negative, nor shorter than `body` makes it."""
    return _SHORTEST - float(vehicle.motor_time_constant), np.inf


def down(vehicle):
    """s: the same of slowing down."""
    usual = float(vehicle.motor_time_constant * vehicle.motor_slowdown_ratio)
    return _SHORTEST - usual, np.inf


_SOURCE = "coreless motors of this size: time constants of 0.02-0.12 s, against a nominal 0.025 s"

EFFECT = Effect(
    name="motor_lag",
    description="first-order lag of the rotor speed, separately for speeding up and slowing down",
    formula=(
        r"\dot\omega_i = (\omega_i^{\ast} - \omega_i)/\tau_{\pm},"
        r"\quad \tau_{\pm} = \tau_{\pm,0} + \Delta\tau_{\pm}"
    ),
    parameters={
        "extra_up": Parameter(
            "s", 0.0, (-0.005, 0.095), _SOURCE, "added to the time constant of speeding up", up
        ),
        "extra_down": Parameter(
            "s", 0.0, (-0.005, 0.095), _SOURCE, "added to the time constant of slowing down", down
        ),
    },
    body=body,
    card=Card(
        fitted=tuple(
            Fitted(
                name,
                mean=0.0,
                spread=0.03,
                start=0.01,
                step=0.0005,
                error=0.001,
                sample=sample,
                practical=practical,
                nuisance=Nuisance(off, duty_cycles=0.01, samples=0.01),
            )
            for name, sample, practical, off in (
                ("extra_up", 0.02, 0.0025, spin_up_error),
                ("extra_down", 0.03, 0.004, spin_down_error),
            )
        ),
        common=0.03,
        possible=lags,
        days=0.0,
        next_flight="roll, pitch and thrust doublets, as short as the vehicle allows.",
    ),
)
