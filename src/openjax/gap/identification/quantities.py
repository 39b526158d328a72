"""A vehicle as its flights show it: numbers beside the simulator's, and responses."""

from dataclasses import asdict, dataclass

import numpy as np

from openjax.flights.flight import Case
from openjax.flights.grid import own_tracks
from openjax.flights.track import Track
from openjax.gap.decision import DECISION
from openjax.gap.identification.estimates import EffectEstimates, of_fit
from openjax.gap.identification.forces import identify_forces, trims
from openjax.gap.identification.prediction_errors import NAMES
from openjax.gap.identification.responses import Pair, responses
from openjax.gap.identification.search import SEARCHED, TorqueFit
from openjax.gap.identification.torques import identify_torques

REACH = 1.645  # standard deviations of a 90 % interval
TALKED_OF = 5.0  # Hz: where rate loops of such vehicles work
MAP = (
    "motor commands are duty cycles: inertia and yaw ratio hold the unknown slope of their thrust, "
    "too"
)
SAMPLES = (
    "a row's motors are one sample of a loop that runs several times within it; log their "
    "means at 100 Hz, or every sample at 500 Hz"
)
POSITIVE = ("spin_up", "spin_down", "roll_gain", "pitch_gain", "yaw_gain")
MATTERS = {
    "motor_lag": DECISION.lag_departure,
    "inertia": DECISION.inertia_departure,
    "yaw_torque": DECISION.yaw_departure,
}
"""s, and shares: differences from which training should know, by effect."""


@dataclass(frozen=True)
class Kind:
    """A number in words, the effect to which it belongs, and its unit."""

    words: str
    effect: str = ""
    unit: str = "1"


KINDS = {
    "spin_up": Kind("time constant of speeding up", "motor_lag", "s"),
    "spin_down": Kind("time constant of slowing down", "motor_lag", "s"),
    "delay": Kind("delay of the motors", "motor_lag", "s"),
    "damping": Kind("damping of roll and pitch", unit="1/s"),
    "yaw_damping": Kind("damping of yaw", unit="1/s"),
    "inertia_roll": Kind("inertia about x, as a multiple", "inertia"),
    "inertia_pitch": Kind("inertia about y, as a multiple", "inertia"),
    "yaw_ratio": Kind("torque over inertia about z, as a multiple", "yaw_torque"),
    "thrust_level": Kind("thrust, as a multiple", "thrust_scale"),
    "thrust_slope": Kind("slope of the thrust, as a multiple", "thrust_curve"),
    "sag": Kind("thrust per volt of the battery", "battery_sag", "1/V"),
    "drag_xy": Kind("drag in the rotor plane", "rotor_drag", "N s/m"),
    "drag_z": Kind("drag along the rotor axes", "rotor_drag", "N s/m"),
    "roll_trim": Kind("trim of roll, share of the thrust", "motor_imbalance"),
    "pitch_trim": Kind("trim of pitch, share of the thrust", "motor_imbalance"),
    "yaw_trim": Kind("trim of yaw, share of the thrust", "motor_imbalance"),
}
"""Every number of a vehicle that may be told by its motion."""


def words_of(name: str) -> str:
    """The name of a number in words: one of `KINDS`, or "effect.parameter"."""
    return KINDS[name].words if name in KINDS else name.replace(".", " ").replace("_", " ")


@dataclass(frozen=True)
class Quantity:
    """A number with its 90 % interval, beside the nominal simulator's. `effect`: whose
    share of the gap it has a part in; `at_bound`: the search ended where nothing is
    looked for beyond.
    """

    value: float
    interval90: tuple[float, float]
    simulator: float
    unit: str = "1"
    effect: str = ""
    at_bound: bool = False

    @property
    def differs(self) -> bool:
        """True if the interval leaves the simulator's value out."""
        return not self.interval90[0] <= self.simulator <= self.interval90[1]

    @property
    def departs(self) -> bool:
        """True if a positive number differs from the simulator's by three standard
        deviations, and by as much as training should know.
        """
        least = MATTERS.get(self.effect)
        if least is None or self.simulator <= 0.0 or self.value <= 0.0:
            return False
        error = DECISION.clear_errors / REACH * np.log(self.interval90[1] / self.value)
        ratio = abs(np.log(self.value / self.simulator))
        return bool(ratio > error and abs(self.value - self.simulator) > least)

    @property
    def scale(self) -> tuple[float, str]:
        """Factor and unit in which the number is printed: times in ms."""
        if self.unit == "s":
            return 1e3, " ms"
        return 1.0, "" if self.unit == "1" else f" {self.unit}"

    def as_text(self) -> str:
        """The number with its 90 % interval."""
        factor, unit = self.scale
        value, low, high = (f"{factor * v:.3g}" for v in (self.value, *self.interval90))
        return f"{value}{unit} [{low}, {high}]"

    def beside(self, number: float) -> str:
        """Another number in the same units."""
        factor, unit = self.scale
        return f"{factor * number:.3g}{unit}"


@dataclass(frozen=True, eq=False)
class Identification:
    """`quantities` {name: quantity}, `responses` {axis: measured and simulated},
    `remarks`: what to think of when reading them; `estimates` are for the diagnosis;
    `duty_cycles`: what thrust a motor command makes isn't known, so that gains tell its
    map and the inertia together; `single_samples`: not trusted for one reason alone,
    that rows are such; `gyroscope_gain` that body rates were freed of before.
    """

    quantities: dict[str, Quantity]
    responses: dict[str, Pair]
    remarks: tuple[str, ...]
    estimates: EffectEstimates
    trustworthy: bool = True
    duty_cycles: bool = False
    single_samples: bool = False
    gyroscope_gain: float = 1.0

    def to_dict(self, shares: dict[str, float] | None = None) -> dict:
        """As it stands in `report.json`; `shares` of the gap {effect: share}."""
        shares = shares or {}
        quantities = {
            name: asdict(q) | {"differs": q.differs, "share_of_gap": shares.get(q.effect)}
            for name, q in self.quantities.items()
        }
        return {
            "sentence": self.sentence(),
            "trusted": self.trustworthy,
            "remarks": list(self.remarks),
            "quantities": quantities,
            "responses": {axis: asdict(pair) for axis, pair in self.responses.items()},
        }

    def sentence(self) -> str:
        """The answer of the vehicle, in one sentence."""
        if not self.trustworthy:
            return f"How torques answer can't be told from these logs: {self.remarks[0]}."
        ratio, lead = self.at(TALKED_OF)
        ratio_error, lead_error = self.errors_at(TALKED_OF)
        weaker = abs(np.log(ratio)) > max(ratio_error, DECISION.form_error)
        has_shift = abs(lead) > max(lead_error, np.rad2deg(DECISION.form_error))
        low, high = ratio * np.exp([-ratio_error, ratio_error])
        gain = f"{ratio:.2f} [{low:.2f}, {high:.2f}]"
        shift = f"{abs(lead):.0f}° {'later' if lead < 0.0 else 'earlier'}"
        text = f"At {TALKED_OF:g} Hz this vehicle turns "
        if not weaker and not has_shift:
            return f"{text}as the simulator does: gain × {gain}, phase {lead:+.0f}°."
        strength = "as strongly as the simulator"
        if weaker:
            strength = f"with {gain} of the simulator's acceleration"
        return f"{text}{strength}, {shift if has_shift else 'in phase with it'}."

    def in_words(self, effect: str) -> str:
        """The numbers that belong to an effect and depart from the simulator's."""
        return "; ".join(
            f"{KINDS[name].words} {q.as_text()}, the simulator's {q.beside(q.simulator)}"
            for name, q in self.quantities.items()
            if q.effect == effect and q.departs
        )

    def at(self, frequency: float) -> tuple[float, float]:
        """Gain as a share of the simulator's, and phase beyond it in degrees: means of
        roll and pitch.
        """
        pairs = [self.responses[axis] for axis in ("roll", "pitch")]
        points = [(p.measured.at(frequency), p.simulated.at(frequency)) for p in pairs]
        ratio = np.mean([m[0] / s[0] for m, s in points])
        lead = np.mean([(m[1] - s[1] + 180.0) % 360.0 - 180.0 for m, s in points])
        return float(ratio), float(lead)

    def errors_at(self, frequency: float) -> tuple[float, float]:
        """Half widths of the 90 % intervals of `at`: of the gain's logarithm, and of the
        phase in degrees.
        """
        squares = np.zeros(2)
        for axis in ("roll", "pitch"):
            for response in (self.responses[axis].measured, self.responses[axis].simulated):
                (gain_low, _, gain_high), (low, _, high) = response.band_at(frequency)
                squares += np.square([0.5 * np.log(gain_high / gain_low), 0.5 * (high - low)])
        gain, phase = 0.5 * np.sqrt(squares)
        return float(gain), float(phase)


def identify(case: Case, one_clock: bool = True, gain_error: float = 0.0) -> Identification | None:
    """Identify the vehicle of a case by its flights; None where none has motors and
    body rates. Without `one_clock` streams were found to be apart by times that wander:
    what is said of torques then isn't trusted. `gain_error`: standard deviation of the
    gyroscope's gain.
    """
    records = own_tracks(case)
    if not records:
        return None
    fit = identify_torques(records, one_clock).with_gain_error(gain_error)
    reasons = doubts(records, fit, one_clock)
    duty_cycles = case.vehicle_file.motor.command == "pwm"
    remarks = (*_remarks(fit), *([MAP] if duty_cycles else []))
    return Identification(
        quantities_of(records, fit),
        responses(records, fit),
        (*reasons, *remarks),
        of_fit(fit, records[0].vehicle),
        trustworthy=not reasons,
        duty_cycles=duty_cycles,
        single_samples=reasons == (SAMPLES,),
    )


def quantities_of(records: list[Track], fit: TorqueFit) -> dict[str, Quantity]:
    vehicle = records[0].vehicle
    up = float(vehicle.motor_time_constant)
    usual = dict.fromkeys(NAMES, 0.0) | {
        "spin_up": up,
        "spin_down": up * float(vehicle.motor_slowdown_ratio),
    }
    deviation = np.sqrt(np.diag(fit.covariance))
    numbers = dict(zip(NAMES, zip(fit.value, deviation, strict=True), strict=True))
    gains = {
        "inertia_roll": _inverse(numbers.pop("roll_gain")),
        "inertia_pitch": _inverse(numbers.pop("pitch_gain")),
        "yaw_ratio": numbers.pop("yaw_gain"),
    }
    numbers.pop("propellers")
    numbers |= gains | identify_forces(records, np.maximum(fit.value[:3], [1e-3, 1e-3, 0.0]))
    usual |= dict.fromkeys((*gains, "thrust_level", "thrust_slope"), 1.0)
    # Trims hold against what else acts too: they belong to no simulator's number but
    # zero.
    numbers |= trims(records)
    return {
        name: _quantity(name, float(v), float(e), usual.get(name, 0.0))
        for name, (v, e) in numbers.items()
    }


def _inverse(number: tuple[float, float]) -> tuple[float, float]:
    """One over a number, each with its standard deviation."""
    value, deviation = number
    return 1.0 / value, deviation / value**2


def _quantity(name: str, value: float, deviation: float, simulator: float) -> Quantity:
    if name in POSITIVE or name.startswith("inertia") or name == "yaw_ratio":
        reach = float(np.exp(REACH * deviation / value))
        interval = (value / reach, value * reach)
    else:
        interval = (value - REACH * deviation, value + REACH * deviation)
    if name == "delay":
        value = max(value, -1.0)
    bounds = SEARCHED[0] if name.startswith("spin") else SEARCHED[1]
    has_bounds = name.startswith(("spin", "inertia")) or name == "yaw_ratio"
    gain = 1.0 / value if name.startswith("inertia") else value
    ends = has_bounds and bool(np.isclose(bounds, gain, rtol=0.02).any())
    kind = KINDS[name]
    return Quantity(value, interval, simulator, kind.unit, kind.effect, ends)


def doubts(records: list[Track], fit: TorqueFit, one_clock: bool) -> tuple[str, ...]:
    """Reasons not to trust what is said of torques."""
    reasons = []
    if not one_clock:
        reasons.append("the streams of motors and sensors are apart by times that wander")
    if any(r.bridges_holes for r in records):
        reasons.append(
            "motors or body rates are missing so often that no second is whole; log them without "
            "holes"
        )
    if any(r.hides_ticks and r.samples for r in records):
        reasons.append(SAMPLES)
    if any(r.hides_ticks for r in records) and fit.turning[:2].max() < DECISION.least_turning:
        reasons.append("the vehicle hardly turns; fly the segments yaw, agile or step")
    if np.isclose(fit.value[3:6], SEARCHED[1][0], rtol=0.02).any() and not reasons:
        reasons.append("the body hardly answers the motors as they are logged")
    return tuple(reasons)


def _remarks(fit: TorqueFit) -> tuple[str, ...]:
    remarks = []
    clock = fit.clock
    error = float(np.sqrt(fit.covariance[2, 2]))
    if abs(clock) > DECISION.clock_remark + DECISION.standard_errors * error:
        direction = "later" if clock > 0.0 else "earlier"
        remarks.append(f"motors answer {1e3 * abs(clock):.0f} ms {direction} than logged")
    return tuple(remarks)
