"""Calibration: the nominal vehicle's own constants from flights, with intervals and
with what can't be told.

The constants are parameters of effects, fitted all at once by the diagnosis' replay:
through the simulator, with its sensors' nuisances and its coloured noise, beside what
usually acts as well. Errors come from that noise, or from what flights disagree by
where that is more.
"""

import dataclasses
from dataclasses import dataclass, field

import numpy as np

from openjax.background import one_blas_thread
from openjax.errors import UserError
from openjax.flights.flight import Case
from openjax.gap.channels import robust_deviation
from openjax.gap.evidence import Evidence, gather
from openjax.gap.intervals import REACH
from openjax.gap.model.hypotheses import UNEXPOSED, SetFit, fit_set
from openjax.gap.model.library import CARDS, PLACE, library, prior
from openjax.gap.residual import residuals_of
from openjax.vehicle.effects import EFFECTS
from openjax.vehicle.vehicle_numbers import CalibratedValue
from openjax.vehicle.vehicle_tables import CALIBRATED_UNITS

# effects whose parameters are the constants
FITTED = ("thrust_scale", "yaw_torque", "motor_lag", "inertia")
# effects that usually act as well, and mustn't be taken for them
BESIDE = ("rotor_drag", "com_offset", "ground_effect", "ceiling_effect", "downwash")
ITERATIONS = 12
# share of the prior's standard deviation: a constant with a larger one isn't told by
# these flights
DETERMINED = 0.5
# share of the rates' changes that motors explain: below, no constant that rates tell
# can be trusted
LEAST_EXPLAINED = 0.9
HORIZON = 0.25  # s over which changes are explained
YAW_INERTIA_RANGE = (0.7, 1.6)  # of nominal; what it may be where it is assumed
# Relative error (standard deviation) that remains however long one flies: commands and
# states are known every 10 ms only, and thrust differs by up to a per cent from flight
# to flight. Measured by closed loop.
MODEL_ERROR = {
    "thrust_constant": 0.005,
    "torque_constant": 0.005,
    "motor_time_constant": 0.02,
    "inertia": 0.004,
}
TOLD_BY_RATES = ("torque_constant", "motor_time_constant", "inertia")

# What flights can't tell, in words.
_YAW_CLASS = (
    "yaw torque constant against yaw inertia: only their ratio shows in yaw; the inertia is "
    "assumed nominal"
)
_NOT_WEIGHED = (
    "mass against thrust: the mass wasn't weighed, so thrust and torque constants and inertia hold "
    "for the assumed {grams:.1f} g; a mass off by 1 % moves them all by 1 %. Weigh the vehicle"
)
_UNKNOWN_MAP = (
    "the thrust constant: the commands are duty cycles whose map to thrust isn't known. Against "
    "the public map the flights' thrust per assumed mass is {scale:.3g}; torques were scaled alike"
)
_NOT_EXPLAINED = (
    "inertia, torque constant, motor lag: motors explain only {share:.0%} of what the gyroscope "
    "shows. Their clocks may disagree, or something else acts: run openjax.diagnose"
)
_ADVICE = {
    "thrust_constant": "climb and descend hard, or log the pose",
    "torque_constant": "turn left and right sharply",
    "motor_time_constant": (
        "change thrust or rates sharply, with motors and IMU logged on one clock"
    ),
    "inertia": "roll and pitch sharply left and right",
}
_ASSUMED_MASS = "for the assumed mass, which wasn't weighed"


@dataclass(frozen=True)
class FittedConstant:
    """A fitted constant: value, 90 % interval and nominal value, each a tuple of length
    1 (3 for inertia).
    """

    value: tuple[float, ...]
    interval90: tuple[tuple[float, float], ...]
    nominal: tuple[float, ...]
    unit: str
    determined: bool
    """True if these flights tell it: only then it goes into a vehicle file."""
    notes: str = ""


@dataclass(frozen=True)
class Calibration:
    """Result of a calibration."""

    quantities: dict[str, FittedConstant]
    cannot_tell: tuple[str, ...]
    """Questions that these flights leave open, in words."""
    nuisances: dict[str, tuple[float, str]] = field(default_factory=dict)
    """Values that were fitted too: {name: (value, unit)}."""
    explained: dict[str, tuple[float, float]] = field(default_factory=dict)
    """{kind of channel: share of its changes that the nominal vehicle explains, and the
    fitted one}.
    """
    flights: tuple[str, ...] = ()
    seconds: float = 0.0
    """Of all flights together."""

    def calibrated(self) -> dict[str, CalibratedValue]:
        """The entries of the vehicle file: determined quantities only."""
        return {
            name: CalibratedValue(q.value, q.interval90, q.notes)
            for name, q in self.quantities.items()
            if q.determined
        }


@one_blas_thread
def calibrate(case: Case) -> Calibration:
    """Fit thrust constant, torque constant, motor time constant and inertia to a case's
    flights.

    Raises UserError if no flight holds motor commands and body rates.
    """
    usable = tuple(f for f in case.flights if f.has_motors and f.body_rates is not None)
    if not usable:
        raise UserError(
            f"{case.name}: no flight holds motor commands (m1..m4) and the gyroscope; calibration "
            "needs both"
        )
    evidence = gather(dataclasses.replace(case, flights=usable), library())
    exposure = evidence.motion.exposure
    effects = [e for e in CARDS if e in FITTED or (e in BESIDE and exposure[e] >= UNEXPOSED)]
    replay = _without_numbers(evidence.replay)
    fit = fit_set(replay, effects, iterations=ITERATIONS)
    nothing = fit_set(replay, ())
    explained_shares = _explained_shares(replay, nothing, fit)
    # Where gyroscope and attitude share no clock, the rates tell nothing.
    share = explained_shares.get("body rates", (0.0, 0.0))[1]
    quantities = _quantities(evidence, fit, share > LEAST_EXPLAINED)
    return Calibration(
        quantities=quantities,
        cannot_tell=tuple(_cannot_tell(evidence, fit, quantities, share)),
        nuisances={
            f"{e} {p}": (value, EFFECTS[e].parameters[p].unit)
            for e, parameters_of in fit.parameters().items()
            if e in BESIDE
            for p, (value, _) in parameters_of.items()
        },
        explained=explained_shares,
        flights=tuple(dict.fromkeys(t.flight for t in evidence.tracks)),
        seconds=float(sum(len(t) * t.dt for t in evidence.tracks)),
    )


def _without_numbers(replay):
    """A replay in which the vehicle's numbers are what is fitted, and no nuisances. A
    diagnosis lets them vary beside every effect; they come first among the nuisances.
    """
    vehicle = len(replay.numbers)
    return dataclasses.replace(
        replay,
        columns=[c[vehicle:] for c in replay.columns],
        nuisance_names=replay.nuisance_names[vehicle:],
        sizes=[s[vehicle:] for s in replay.sizes],
        numbers=(),
    )


def logarithms(theta: np.ndarray, vehicle, duty_cycles: bool) -> dict[str, np.ndarray]:
    """{constant: logarithms of its values over the nominal ones, (1,) or (2,)} at
    parameters theta (P,). Yaw shows only the ratio of torque to inertia, which is told
    for the nominal inertia; with duty cycles for the nominal thrust constant.
    """
    at = {key: theta[place] for key, place in PLACE.items() if key[0] in FITTED}
    thrust = 1.0 + at["thrust_scale", "scale"]
    torque = (1.0 if duty_cycles else thrust) * at["yaw_torque", "ratio"] / at["inertia", "zz"]
    lag = 0.5 * (at["motor_lag", "extra_up"] + at["motor_lag", "extra_down"])
    estimates = {
        "thrust_constant": [thrust],
        "torque_constant": [torque],
        "motor_time_constant": [1.0 + lag / float(vehicle.motor_time_constant)],
        "inertia": [at["inertia", "xx"], at["inertia", "yy"]],
    }
    return {name: np.log(np.maximum(values, 1e-3)) for name, values in estimates.items()}


def _quantities(evidence: Evidence, fit: SetFit, rates_fit: bool) -> dict[str, FittedConstant]:
    file = evidence.case.vehicle_file
    vehicle = evidence.vehicles[0]
    duty_cycles = file.motor.command == "pwm"
    # where flights disagree by more than the noise explains, errors are as large as
    # that
    robust = robust_deviation(fit.covariance, fit.grams[:, 1:, 0])
    wider = robust / np.sqrt(np.diag(fit.covariance))
    posterior = fit.covariance * np.outer(wider, wider)
    prior_covariance = np.linalg.inv(prior(fit.effects)[2])
    values = logarithms(fit.theta, vehicle, duty_cycles)
    slopes = _slopes(fit, vehicle, duty_cycles)
    out = {}
    for name, value in values.items():
        slope = slopes[name]
        deviation = np.sqrt(np.diag(slope @ posterior @ slope.T))
        prior_deviations = np.sqrt(np.diag(slope @ prior_covariance @ slope.T))
        is_determined = bool((deviation < DETERMINED * prior_deviations).all())
        is_determined &= rates_fit or name not in TOLD_BY_RATES
        is_determined &= not (duty_cycles and name == "thrust_constant")
        total = np.hypot(deviation, MODEL_ERROR[name])
        out[name] = _quantity(name, vehicle, value, total, is_determined)
        if name in ("thrust_constant", "inertia") and not file.mass_weighed:
            notes = "; ".join(n for n in (out[name].notes, _ASSUMED_MASS) if n)
            out[name] = dataclasses.replace(out[name], notes=notes)
    return out


def _slopes(fit: SetFit, vehicle, duty_cycles: bool) -> dict[str, np.ndarray]:
    """{constant: (1 or 2, F) slopes of its logarithms in the F fitted parameters}, by
    difference quotients.
    """
    step = 1e-5
    at_theta = logarithms(fit.theta, vehicle, duty_cycles)
    slopes = {name: [] for name in at_theta}
    for place in fit.index:
        theta = fit.theta.copy()
        theta[place] += step
        for name, value in logarithms(theta, vehicle, duty_cycles).items():
            slopes[name].append((value - at_theta[name]) / step)
    return {name: np.array(columns).T for name, columns in slopes.items()}


def _quantity(
    name: str, vehicle, logs: np.ndarray, deviations: np.ndarray, is_determined: bool
) -> FittedConstant:
    nominal = np.atleast_1d(np.asarray(getattr(vehicle, name), float))
    value = nominal.copy()
    # of the inertia x and y are fitted; z stays nominal, in the range in which it may
    # be
    value[: len(logs)] *= np.exp(logs)
    reach = np.exp(REACH * deviations)
    intervals = zip(value[: len(logs)], reach, strict=True)
    pairs = [(float(v / r), float(v * r)) for v, r in intervals]
    if len(value) > len(logs):
        low, high = YAW_INERTIA_RANGE
        pairs.append((low * nominal[2], high * nominal[2]))
    notes = {
        "inertia": "zz is assumed nominal",
        "torque_constant": "for the nominal inertia about z",
    }
    return FittedConstant(
        value=tuple(value.tolist()),
        interval90=tuple(pairs),
        nominal=tuple(nominal.tolist()),
        unit=CALIBRATED_UNITS[name],
        determined=is_determined,
        notes=notes.get(name, ""),
    )


def _cannot_tell(
    evidence: Evidence, fit: SetFit, quantities: dict[str, FittedConstant], share: float
) -> list[str]:
    """A sentence on what these flights leave open. `share` of the rates' changes that the fitted
    vehicle explains.
    """
    file = evidence.case.vehicle_file
    out = []
    untold = []
    if file.motor.command == "pwm":
        out.append(_UNKNOWN_MAP.format(scale=1.0 + fit.theta[PLACE["thrust_scale", "scale"]]))
        untold.append("thrust_constant")
    if not file.mass_weighed:
        out.append(_NOT_WEIGHED.format(grams=float(evidence.vehicles[0].mass) * 1e3))
    out.append(_YAW_CLASS)
    if share <= LEAST_EXPLAINED:
        out.append(_NOT_EXPLAINED.format(share=max(share, 0.0)))
        untold += TOLD_BY_RATES
    names = [n for n in _ADVICE if n not in untold and not quantities[n].determined]
    return out + [
        f"{n.replace('_', ' ')}: these flights hardly excite it; {_ADVICE[n]}" for n in names
    ]


def _explained_shares(replay, nothing: SetFit, fit: SetFit) -> dict[str, tuple[float, float]]:
    """Per kind of channel the share of its changes over HORIZON that the nominal
    vehicle explains, and the fitted one.
    """
    kinds = {"body rates": slice(0, 3), "velocity": slice(3, 6), "specific force": slice(8, 9)}
    steps = [max(round(HORIZON / t.dt), 1) for t in replay.tracks]

    def square(values, channels) -> float:
        changes = (v[n:, channels] - v[:-n, channels] for v, n in zip(values, steps, strict=True))
        return float(sum((c**2).sum() for c in changes))

    residuals = (residuals_of(nothing), residuals_of(fit))
    shares = {}
    for kind, channels in kinds.items():
        if replay.usable[channels].all():
            total = square(replay.measurements, channels)
            shares[kind] = tuple(1.0 - square(residual, channels) / total for residual in residuals)
    return shares
