"""The cases: a cause each, the flights that are diagnosed, and the effects that the diagnosis finds in them."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from experiments.withheld import cases, causes, sensors
from openjax.vehicle.effects import load_effects

# Three quarters up GAP's usual ranges, in the units of `causes.LIMITS`; the plant's own forms.
SIZES = {
    "motor_lag": 2.8,  # time constant 95 ms instead of 25
    "command_latency": 46.0,  # ms
    "state_latency": 46.0,  # ms
    "packet_loss": 0.38,
    "rotor_drag": 0.024,  # N s/m
    "wind": 2.3,  # m/s
    "battery_sag": 0.3,  # of the thrust per volt
    "thrust_scale": 0.155,
    "thrust_saturation": 0.15,  # the rotors top out at 0.75
    "com_offset": 6.0,  # mm
    "motor_imbalance": 0.11,
    "yaw_torque": 0.64,  # 0.36 or 1.64 times the nominal
    "rate_gains": 0.62,  # P 1.62 or 0.62 times the nominal
    "downwash": 16.0,  # g
}
NONE = "none"
SHORTEST = 700  # ticks of a flight
SATURATION_VOLTAGE = 3.9  # V, to which `thrust_saturation.limit` refers


@dataclass
class Case:
    """A vehicle of the plant with one cause or none."""

    name: str
    seed: int
    number: int
    cause: dict | None
    missions: list = field(default_factory=list)

    @property
    def effect(self) -> str:
        """The name of the cause."""
        return self.cause["effect"] if self.cause else NONE

    @property
    def shared(self) -> dict:
        """What all flights of the vehicle share, as `cases.Flights` draws it."""
        return sensors.draw_case(cases.case_rng(self.seed, self.number, 1))

    def spec(self) -> dict:
        """The case as `cases.Flights` and `cases.write_case` want it."""
        return {"number": self.number, "flights": self.missions, "mass_weighed": False, "name": self.name}


def make_cases(seed: int, replicates: int, nones: int, effects=tuple(SIZES)) -> list[Case]:
    """`replicates` cases of each effect, each in another of the plant's forms, and `nones` without a cause."""
    out = []
    wanted = [(effect, i) for effect in effects for i in range(replicates)] + [
        (NONE, i) for i in range(nones)
    ]
    for effect, i in wanted:
        number = 1000 * (1 + (*SIZES, NONE).index(effect)) + i
        rng = cases.case_rng(seed, number, 5)
        cause = None
        if effect != NONE:
            forms = causes.FORMS[effect]
            cause = causes.draw(rng, effect, forms[i % len(forms)]) | {"size": SIZES[effect]}
            # opposite signs in turn
            cause["shape"][0] = (0.25, 0.9)[i % 2]
        missions = cases.draw_missions(rng, [causes.EXPOSING.get(effect, ())], two=False)
        out.append(Case(f"{effect}_{i}", seed, number, cause, [tuple(map(str, m)) for m in missions]))
    return out


def write_flights(case: Case, folder: Path) -> dict:
    """Fly and log the three flights of a case; returns the magnitudes of the cause, its size and the flights' ticks.

    A vehicle that the plant's own controller can't keep in the air for 7 s of each flight gets a smaller cause
    (`case.cause` is changed).
    """
    for _ in range(6):
        flights = cases.Flights(case.seed, [case.spec()])
        flown, magnitudes = flights.fly([[case.cause] if case.cause else []])
        if case.cause is None or flown["crashed"].min() >= SHORTEST:
            break
        case.cause["size"] *= 0.85
    ticks = cases.write_case(folder, case.spec(), flights, flown, 0)
    return {
        "size": case.cause["size"] if case.cause else None,
        "form": case.cause["form"] if case.cause else None,
        "magnitudes": _plain(magnitudes[0][0]) if case.cause else {},
        "missions": [list(m) for m in case.missions],
        "ticks": ticks,
    }


def diagnose_flights(folder: Path) -> dict:
    """Diagnose a case's flights and write its report and effects.toml beside them; returns what was found."""
    from openjax.gap import load_case
    from openjax.gap.diagnosis import diagnose_case
    from openjax.gap.report import write_report

    loaded = load_case(folder)
    report = diagnose_case(loaded)
    write_report(report, folder, pictures=False)
    voltages = [f.battery_voltage for f in loaded.flights if f.battery_voltage is not None]
    told = report.to_dict()
    return {
        "verdict": report.verdict,
        "effects": list(report.effects),
        "equivalent": report.equivalent,
        "parameters": told["parameters"],
        "gap": told["gap"],
        "voltage": float(np.nanmedian(np.concatenate(voltages))) if voltages else None,
    }


def corrected_effects(folder: Path, voltage: float | None) -> tuple[tuple[str, ...], dict]:
    """What effects.toml says to fly with.

    How thrust follows the battery is in the file; which voltage is flown at is the user's to say, here the median
    that the flights logged.
    """
    names, parameters = load_effects(folder / "effects.toml")
    if "battery_sag" in names and voltage is not None:
        parameters["battery_sag"] |= {"full": voltage, "discharge": 0.0}
    if "thrust_saturation" in names and voltage is not None:
        own = parameters["thrust_saturation"]
        own["limit"] *= 1.0 + own.get("voltage_slope", 0.0) * (voltage - SATURATION_VOLTAGE)
        own["voltage_slope"] = 0.0
    return names, parameters


def _plain(value):
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return round(float(value), 6)
