"""The cases: a cause each, the flights that are diagnosed, and the effects that the diagnosis finds in them."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from experiments.diagnosis import cases, fleet, vehicle
from experiments.diagnosis.effects import EFFECTS, draw
from experiments.worlds.plant import rng_of, sensors_of
from openjax.vehicle.effects import load_effects

# Three quarters up the usual ranges, in the units of `effects.EFFECTS`; the plant's own forms.
SIZES = {
    "motor_lag": 2.8,  # time constant 95 ms instead of 25
    "command_latency": 46.0,  # ms
    "state_latency": 46.0,  # ms
    "packet_loss": 0.38,
    "rotor_drag": 0.024,  # N s/m
    "wind": 2.3,  # m/s
    "battery_sag": 0.3,  # of the thrust per volt
    "thrust_scale": 0.155,
    "thrust_saturation": 0.66,  # of the room above hover: the rotors top out at 0.75
    "com_offset": 6.0,  # mm
    "motor_imbalance": 0.11,
    "yaw_torque": 0.64,  # 0.36 or 1.64 times the nominal
    "rate_gains": 0.62,  # P 1.62 or 0.62 times the nominal
    "downwash": 16.0,  # g
}
NONE = "none"
SHORTEST = 0.7  # of a flight, before a vehicle crashes
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

    def spec(self) -> dict:
        """The case as the exam's generator wants it."""
        return {
            "name": self.name,
            "number": self.number,
            "missions": self.missions,
            "ticks": [cases.TICKS] * len(self.missions),
            "controller": "geometric",
            "sensors": sensors_of(self.seed, self.number),
            "told": vehicle.Told(),
            "garbage": None,
        }


def make_cases(seed: int, replicates: int, nones: int, effects=tuple(SIZES)) -> list[Case]:
    """`replicates` cases of each effect, each in another of the plant's forms, and `nones` without a cause."""
    out = []
    wanted = [(effect, i) for effect in effects for i in range(replicates)] + [
        (NONE, i) for i in range(nones)
    ]
    for effect, i in wanted:
        number = 1000 * (1 + (*SIZES, NONE).index(effect)) + i
        rng = rng_of(seed, number, 5)
        cause, needed = None, []
        if effect != NONE:
            _, forms, exposing, _ = EFFECTS[effect]
            form = forms[i % len(forms)]
            cause, needed = draw(rng, effect, form) | {"size": SIZES[effect]}, [exposing]
            # opposite signs in turn
            cause["shape"][0] = (0.25, 0.9)[i % 2]
        missions = cases.draw_missions(rng, needed, "excite", two=False)
        out.append(Case(f"{effect}_{i}", seed, number, cause, missions))
    return out


def write_flights(case: Case, folder: Path) -> dict:
    """Fly and log the three flights of a case; returns the magnitudes of the cause, its size and the flights' ticks.

    A vehicle that the plant's own controller can't keep in the air for most of each flight gets a smaller cause
    (`case.cause` is changed).
    """
    spec = case.spec()
    drawn = {case.name: fleet.bodies(case.seed, "known", spec)}
    for _ in range(6):
        flown = fleet.Fleet(case.seed, "known", [(spec, [case.cause] if case.cause else [])], drawn)
        if case.cause is None or flown.lasts(0) >= SHORTEST:
            break
        case.cause["size"] *= 0.85
    rows, _ = fleet.write_case(flown, 0, folder)
    return {
        "size": case.cause["size"] if case.cause else None,
        "form": case.cause["form"] if case.cause else None,
        "magnitudes": _plain(flown.magnitudes[0][0]) if case.cause else {},
        "missions": [list(m) for m in case.missions],
        "ticks": [len(flight[0]["t"]) for flight in rows],
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
