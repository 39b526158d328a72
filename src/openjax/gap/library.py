"""How each effect of `openjax.vehicle.effects` is fitted: which parameters, where to start, what is
plausible.

Priors are weak: their spread is of the order of the effect's usual range. A *companion* is a parameter of
another effect that may move a little whenever this one does, because real effects seldom have exactly the
library's form (a payload adds inertia, drag acts above the centre of mass)."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from openjax.errors import UserError
from openjax.vehicle.effects import EFFECTS

PATHS = ("physics", "radio", "rate_loop", "estimator")
_PATH = {
    "command_latency": "radio",
    "packet_loss": "radio",
    "rate_gains": "rate_loop",
    "state_latency": "estimator",
}


@dataclass(frozen=True)
class Fitted:
    """One fitted parameter: prior mean and standard deviation, start of the search, step of the difference
    quotient, all in the parameter's unit. `positive`: a value below the effect-free one is implausible."""

    name: str
    mean: float
    spread: float
    start: float
    step: float
    positive: bool = False


@dataclass(frozen=True)
class Fit:
    """How one effect is fitted. `common` is the spread that all its parameters share; `balanced`: their mean
    belongs to another effect and is held near zero; `linear`: the first scales the whole effect; `others`
    are more starts; `companions` are ((effect, parameter, spread), ...)."""

    effect: str
    parameters: tuple[Fitted, ...]
    common: float = 0.0
    balanced: bool = False
    linear: bool = False
    others: tuple[tuple[float, ...], ...] = ()
    companions: tuple[tuple[str, str, float], ...] = ()


def _p(name, mean, spread, start, step, positive=False):
    return Fitted(name, mean, spread, start, step, positive)


FITS = {
    fit.effect: fit
    for fit in (
        Fit(
            "mass",
            (_p("extra", 0.0, 0.005, 0.001, 2e-5),),
            companions=(("inertia", "xx", 0.02), ("inertia", "yy", 0.02), ("inertia", "zz", 0.02)),
        ),
        Fit(
            "thrust_scale", (_p("scale", 0.0, 0.1, 0.02, 1e-3),), companions=(("yaw_torque", "ratio", 0.03),)
        ),
        Fit(
            "battery_sag",
            (_p("exponent", 0.0, 1.0, 0.5, 1e-2, True), _p("reference", 3.85, 0.15, 3.85, 1e-2)),
        ),
        Fit(
            "thrust_saturation",
            (_p("limit", 0.8, 0.12, 0.8, 2e-3), _p("voltage_slope", 0.0, 0.1, 0.0, 1e-2)),
            others=tuple((limit, 0.0) for limit in (0.95, 0.92, 0.89, 0.865, 0.84, 0.76, 0.7)),
        ),
        Fit(
            "thrust_curve",
            (
                _p("offset", 0.0, 0.08, 0.02, 1e-3),
                _p("slope", 1.0, 0.2, 0.95, 1e-3),
                _p("curvature", 0.0, 0.25, 0.02, 1e-3),
            ),
        ),
        Fit(
            "rotor_drag",
            (_p("d_xy", 0.0, 0.015, 0.01, 1e-4, True), _p("d_z", 0.0, 0.012, 0.005, 1e-4, True)),
            companions=(("blade_flapping", "stiffness", 4e-5),),
        ),
        Fit(
            "blade_flapping",
            (_p("tilt", 0.0, 0.02, 0.005, 1e-4, True), _p("stiffness", 0.0, 2e-4, 3e-5, 1e-6)),
        ),
        Fit(
            "wind",
            (
                _p("x", 0.0, 1.5, 0.3, 1e-2),
                _p("y", 0.0, 1.5, 0.3, 1e-2),
                _p("z", 0.0, 0.5, 0.0, 1e-2),
                _p("drag", 0.013, 0.006, 0.013, 1e-4, True),
            ),
        ),
        Fit(
            "ground_effect",
            (_p("strength", 0.0, 0.8, 0.4, 1e-2, True), _p("offset", 0.012, 0.01, 0.012, 5e-4)),
            linear=True,
            others=((0.4, 0.0), (0.4, 0.025), (0.4, 0.05)),
        ),
        Fit(
            "ceiling_effect",
            (_p("strength", 0.0, 0.8, 0.4, 1e-2, True), _p("offset", 0.012, 0.025, 0.012, 5e-4)),
            linear=True,
            others=((0.4, 0.0), (0.4, 0.025), (0.4, 0.05)),
        ),
        Fit(
            "downwash",
            (
                _p("force", 0.0, 0.1, 0.08, 1e-3, True),
                _p("length", 0.5, 0.25, 0.5, 5e-3),
                _p("width", 0.045, 0.012, 0.045, 5e-4),
                _p("spread", 0.1, 0.06, 0.1, 2e-3),
            ),
            linear=True,
            others=((0.05, 0.8, 0.06, 0.15), (0.08, 0.3, 0.03, 0.08)),
        ),
        Fit(
            "motor_lag",
            (_p("extra_up", 0.0, 0.03, 0.01, 5e-4), _p("extra_down", 0.0, 0.03, 0.01, 5e-4)),
            common=0.03,
        ),
        Fit(
            "motor_imbalance",
            tuple(_p(f"m{i}", 0.0, 0.05, s, 1e-3) for i, s in ((1, 0.02), (2, -0.01), (3, 0.0), (4, -0.01))),
            balanced=True,
        ),
        Fit("com_offset", (_p("x", 0.0, 2e-3, 3e-4, 2e-5), _p("y", 0.0, 2e-3, 3e-4, 2e-5))),
        Fit("inertia", tuple(_p(axis, 1.0, 0.12, 1.1, 5e-3) for axis in ("xx", "yy", "zz")), common=0.3),
        Fit("yaw_torque", (_p("ratio", 1.0, 0.5, 0.9, 5e-3),)),
        Fit("command_latency", (_p("delay", 0.0, 0.02, 0.01, 5e-4, True),)),
        Fit("packet_loss", (_p("probability", 0.0, 0.15, 0.05, 1e-2, True),)),
        Fit("rate_gains", tuple(_p(gain, 1.0, 0.4, 1.0, 5e-2) for gain in ("p", "i", "d"))),
        Fit("state_latency", (_p("delay", 0.0, 0.02, 0.0, 5e-4, True),)),
    )
}
# Small errors of the vehicle's numbers that no effect is blamed for: GAP's "thrust offset up to 1 %", and
# what the replay's own step and the half-known motor commands inside a row leave.
NUISANCES = (
    ("thrust_scale", "scale", 0.004),
    ("inertia", "xx", 0.01),
    ("inertia", "yy", 0.01),
    ("inertia", "zz", 0.01),
    ("motor_lag", "extra_up", 3e-4),
    ("motor_lag", "extra_down", 3e-4),
)
# With duty cycles for motor commands the map to thrust is a guess: scale, shape, lag and torques are free,
# and what they can imitate isn't testable.
PWM_NUISANCES = (
    ("thrust_scale", "scale", 0.3),
    ("inertia", "xx", 0.2),
    ("inertia", "yy", 0.2),
    ("inertia", "zz", 0.2),
    ("motor_lag", "extra_up", 0.01),
    ("motor_lag", "extra_down", 0.01),
    ("thrust_curve", "offset", 0.15),
    ("thrust_curve", "curvature", 0.3),
    ("yaw_torque", "ratio", 0.5),
)
BALANCE = 0.99  # share of the common variance that `balanced` parameters go without
MOTOR_SHIFT = 0.001  # s, standard deviation of the motors' clock offset


@dataclass(frozen=True)
class Library:
    """The effects that may be named, in one order, and the vector of all physics parameters."""

    effects: tuple[str, ...] = tuple(EFFECTS)
    _cache: dict = field(default_factory=dict, compare=False, repr=False)

    @cached_property
    def physics(self) -> tuple[str, ...]:
        """Effects that act between the motors and the motion."""
        return tuple(e for e in self.effects if path_of(e) == "physics")

    def names(self, path: str) -> tuple[str, ...]:
        return tuple(e for e in self.effects if path_of(e) == path)


# Every physics parameter has a fixed place in theta, whatever is left out of a library: one compiled
# function.
PHYSICS_EFFECTS = tuple(e for e in FITS if e not in _PATH)
THETA = tuple((e, p.name) for e in PHYSICS_EFFECTS for p in FITS[e].parameters)
PLACE = {key: number for number, key in enumerate(THETA)}
ABSENT = np.array([EFFECTS[e].parameters[p].none for e, p in THETA] + [0.0])
STEP = np.array([p.step for e in PHYSICS_EFFECTS for p in FITS[e].parameters] + [2e-4])


def path_of(effect: str) -> str:
    """By which path of the log an effect is read: one of PATHS."""
    return _PATH.get(effect, "physics")


def library(without=()) -> Library:
    """All effects but those in `without`. Raises UserError for unknown names."""
    for name in without:
        if name not in EFFECTS:
            raise UserError(f"--without {name}: no such effect; known: {', '.join(EFFECTS)}")
    return Library(tuple(e for e in EFFECTS if e in FITS and e not in without))


def places(effects) -> np.ndarray:
    """Indices in theta of the own parameters of physics effects."""
    return np.array([PLACE[e, p.name] for e in effects for p in FITS[e].parameters], int)


def start_of(effect: str, number: int = 0) -> np.ndarray:
    """A start of the search: the first, or one of the `others`."""
    fit = FITS[effect]
    return np.array([p.start for p in fit.parameters]) if number == 0 else np.array(fit.others[number - 1])


def prior(effects) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Indices (p,), mean (p,) and precision (p, p) of the parameters of a set of physics effects,
    companions last."""
    index, mean, blocks = [], [], []
    for effect in effects:
        fit = FITS[effect]
        index += [PLACE[effect, p.name] for p in fit.parameters]
        mean += [p.mean for p in fit.parameters]
        block = np.diag([p.spread**2 for p in fit.parameters]) + fit.common**2
        blocks.append(block - BALANCE * block.mean() if fit.balanced else block)
    for effect in effects:
        for other, parameter, spread in FITS[effect].companions:
            if PLACE[other, parameter] not in index:
                index.append(PLACE[other, parameter])
                mean.append(ABSENT[index[-1]])
                blocks.append(np.array([[spread**2]]))
    size = len(index)
    covariance, at = np.zeros((size, size)), 0
    for block in blocks:
        covariance[at : at + len(block), at : at + len(block)] = block
        at += len(block)
    precision = np.linalg.inv(covariance) if size else covariance
    return np.array(index, int), np.array(mean), precision
