"""Do the motors turn the vehicle in the order and with the spins that were told?"""

import itertools

import numpy as np

from openjax.flights.flight import Finding
from openjax.flights.pairs import AGREE, TURNING, Signals
from openjax.flights.signals import RATE, first_order, in_band

MOTORS = "the motors' torques"
IDENTITY = ((0, 1, 2, 3), 1.0)  # order and spin as logged
OFFSETS = range(-20, 21, 2)  # rows by which the motors' clock may be off


def order_findings(signals: Signals, vehicle) -> list[Finding]:
    """Motors in another order or with other spins, or whose torques the body doesn't
    follow at all.
    """
    torques = _torques(signals, vehicle)
    if not torques:
        return []
    track_torques = torques[IDENTITY]
    (order, flip), best = max(torques.items(), key=lambda item: item[1].sum())
    # The right order explains every axis; an offset mass or weak motor can spoil one or
    # two, and isn't an order.
    if (
        best.min() > 0.4
        and best.mean() > 0.65
        and (track_torques < AGREE * best).any()
        and (best - track_torques).sum() > 0.6
    ):
        return [("motors", _order_in_words(order, flip), [MOTORS])]
    if (in_band(signals.rates[:, :2], TURNING).std(0) > 0.3).all() and track_torques[
        :2
    ].max() < 0.15:
        text = f"correlation {track_torques[0]:.2f} in roll and {track_torques[1]:.2f} in pitch"
        text += f" while the body turns at {signals.rates[:, :2].std():.1f} rad/s"
        return [
            (
                "garbage",
                f"contradictory: {MOTORS} against the angular acceleration: {text}",
                [MOTORS],
            )
        ]
    return []


def torques_fit(signals: Signals, vehicle) -> bool:
    """True if roll and pitch clearly turn as the motors in their order say."""
    torques = _torques(signals, vehicle)
    return bool(torques and torques[IDENTITY][:2].min() > 0.4)


def _torques(signals: Signals, vehicle) -> dict[tuple, np.ndarray]:
    """{(order, spin's sign): correlation (3,) of the angular acceleration with the
    torques that motors in this order make}.
    """
    if signals.motor is None or signals.rates is None:
        return {}
    place = np.asarray(vehicle.rotor_position, float)
    spin = np.asarray(vehicle.rotor_spin, float)
    # roll, pitch and yaw torque per thrust
    mixing = np.stack([place[:, 1], -place[:, 0], spin])
    turns = in_band(np.gradient(signals.rates, 1 / RATE, axis=0), TURNING)
    thrusts = in_band(first_order(signals.motor, float(vehicle.motor_time_constant)), TURNING)
    if (thrusts.std(0) < 1e-6).all():
        return {}
    # Motors are correlated, so whole torques are scored: by the moments of angular
    # acceleration and motors at each offset.
    at_offsets = np.stack([np.roll(thrusts, lag, 0) for lag in OFFSETS])
    cross = np.einsum("ti,ltj->lij", turns, at_offsets)
    among = np.einsum("lti,ltj->lij", at_offsets, at_offsets)
    torques = {}
    for order, flip in itertools.product(itertools.permutations(range(4)), (1.0, -1.0)):
        mixer_rows = mixing[:, order] * [[1.0], [1.0], [flip]]
        power = np.einsum("ij,ljk,ik->li", mixer_rows, among, mixer_rows) * (turns**2).sum(0)
        each = (mixer_rows * cross).sum(2) / np.sqrt(np.maximum(power, 1e-24))
        torques[order, flip] = each[int(np.argmax(each.sum(1)))]
    return torques


def _order_in_words(order: tuple[int, ...], flip: float) -> str:
    if order == IDENTITY[0]:
        text = "the rotors' spin is opposite: yaw accelerates against the torque of m1..m4"
        return f"{text}; reverse motor.spin in vehicle.toml"
    names = ("front_right", "rear_right", "rear_left", "front_left")
    words = ", ".join(f"m{i + 1} {names[o]}" for i, o in enumerate(order))
    words += " with the spins reversed" if flip < 0 else ""
    text = f"motor order: the angular acceleration fits only if (in the nominal order) {words}"
    return f"{text}; correct motor.order in vehicle.toml"
