"""From a plan of cases to flown batches: which missions, which parameters, and the severity of what was
drawn.
"""

import json
from pathlib import Path

import numpy as np

from experiments.withheld import body, causes, missions, plant, replay, sensors, unknowns

TICKS = 1200
FLOOR_FILE = Path(__file__).with_name("floor.json")
BANDS = {"low": (0.8, 1.6), "medium": (2.0, 4.0), "high": (5.0, 40.0)}


def label(severity):
    """Severity band that a measured ratio to the noise floor falls into."""
    return "hidden" if severity < 0.5 else "low" if severity < 2.0 else "medium" if severity < 4.5 else "high"


def case_rng(seed, case, *more):
    return np.random.default_rng(np.random.SeedSequence([seed, case, *more]))


def draw_missions(rng, needed, two):
    """Three flights: list of (mission,) or (mission_of_0, mission_of_1). `needed`: list of tuples of exposing
    missions.
    """
    flights = [None, None, None]
    order = rng.permutation(3)
    slot = 0
    for options in needed * 2:  # each cause is exposed in two of the flights where there is room
        if slot < 3 and options:
            flights[order[slot]] = options[int(rng.integers(len(options)))]
            slot += 1
    rest = [m for m in missions.SINGLE if m not in flights]
    fill = iter(rng.permutation(rest))
    flights = [f if f is not None else str(next(fill)) for f in flights]
    if not two and not any(f in missions.PAIR for f in flights):
        return [(f,) for f in flights]
    return [(f, f) if f in missions.PAIR else (f, str(rng.choice(missions.SINGLE))) for f in flights]


def _with_nuisance(cause, spec):
    """Magnitudes together with the nuisance of the case that acts in the same way and that no flight can
    split off.
    """
    offset = 1 + spec["thrust_offset"]
    sign = 1 if cause["shape"][0] < 0.5 else -1
    if cause["effect"] == "mass":
        return {"seen_extra_kg": body.MASS * ((1 + sign * cause["size"]) / offset - 1)}
    if cause["effect"] == "thrust_scale":
        return {"seen_scale": (1 + sign * cause["size"]) * offset - 1}
    if cause["effect"] == "state_latency":
        # mean of the jitter's absolute value: 0.8 of its standard deviation
        return {"seen_delay_ms": cause["size"] + spec["mocap_delay"] + 0.8 * sensors.MOCAP_JITTER}
    return {}


class Flights:
    """The bodies of a list of cases: reference, noise and partner of each, and which columns belong to which
    case.
    """

    def __init__(self, seed, specs):
        """specs: list of {"number", "flights": [(mission, ...)]}; noise and references depend on seed and
        number alone.
        """
        self.specs, references, noises, partner = specs, [], [], []
        self.columns, self.of_flight, self.ticks = [], [], []
        for spec in specs:
            rng = case_rng(seed, spec["number"], 1)
            shared = sensors.draw_case(rng)
            spec["thrust_offset"], spec["mocap_delay"] = shared["thrust_offset"], shared["mocap_delay"]
            start, flights, lengths = len(references), [], []
            for mission in spec["flights"]:
                length = int(rng.integers(900, TICKS + 1))
                if mission[0] in missions.PAIR:
                    refs = missions.pair(mission[0], rng, TICKS)
                elif len(mission) == 2:
                    refs = [
                        missions.apart(missions.single(m, rng, TICKS), side)
                        for m, side in zip(mission, (-1, 1), strict=True)
                    ]
                else:
                    refs = [missions.single(mission[0], rng, TICKS)]
                here = list(range(len(references), len(references) + len(refs)))
                voltage = shared["voltage"] + rng.uniform(-0.25, 0.15)
                for r in refs:
                    references.append(r)
                    noises.append(sensors.draw_flight(rng, shared, TICKS, voltage + rng.uniform(-0.02, 0.02)))
                # each of a pair may have the other above it
                partner += here[::-1] if len(here) == 2 else here
                flights.append(here)
                lengths.append(length)
            self.columns.append(np.arange(start, len(references)))
            self.of_flight.append(flights)
            self.ticks.append(lengths)
        self.reference = {k: np.stack([r[k] for r in references], axis=-1) for k in references[0]}
        self.noise, self.partner, self.seed = sensors.stack(noises), np.array(partner), seed
        self.count = len(references)

    def fly(self, causes_of):
        """Fly all with the causes per case; returns what `plant.fly` gives and the magnitudes per case."""
        p = body.nominal_parameters(self.count)
        arrival = np.repeat(10.0 * np.arange(TICKS)[:, None], self.count, axis=1)
        strangers, magnitudes = {}, []
        for spec, columns, own in zip(self.specs, self.columns, causes_of, strict=True):
            p["rotor_gain"][:, columns] *= 1 + spec["thrust_offset"]
            said = []
            for i, cause in enumerate(own):
                if cause["effect"] in causes.EFFECTS:
                    said.append(
                        causes.apply(cause, p, columns, arrival, case_rng(self.seed, spec["number"], 2, i))
                    )
                else:
                    typical, unit, _ = unknowns.KINDS[cause["effect"]]
                    entry = strangers.setdefault(
                        cause["effect"],
                        {"strength": np.zeros(self.count), "shape": np.zeros((8, self.count))},
                    )
                    entry["strength"][columns] = typical * cause["size"]
                    entry["shape"][:, columns] = np.asarray(cause["shape"])[:, None]
                    said.append({"strength": typical * cause["size"], "unit": unit})
            magnitudes.append(said)
        flown = plant.fly(plant.Batch(p, self.reference, self.partner, arrival, self.noise, strangers))
        flown["pose"] = flown["measured_quaternion"]
        return flown, magnitudes

    def logged(self, flown):
        """The log of every body as (K, n, B) arrays for `replay.errors`."""
        rows = [sensors.log_rows(flown, self.noise, i, TICKS) for i in range(self.count)]
        rows = np.stack(rows, axis=-1)
        return {
            "position": rows[:, 0:3],
            "quaternion": rows[:, 3:7],
            "velocity": rows[:, 7:10],
            "rates": rows[:, 10:13],
            "pose": rows[:, 3:7],
        }

    def rms(self, errors, flown):
        """Root mean square per channel and case (12, cases), windows after a crash left out."""
        starts = np.arange(100, TICKS - replay.LONG - 1, 20)[:, None]
        valid = starts + replay.LONG < flown["crashed"] - 5
        out = np.zeros((len(replay.CHANNELS), len(self.specs)))
        for i, columns in enumerate(self.columns):
            ok = valid[:, columns]
            squares = np.where(ok, errors[:, :, columns] ** 2, 0.0).sum(axis=(1, 2))
            out[:, i] = np.sqrt(squares / max(ok.sum(), 1))
        return out


def exposure(flown, flights, index):
    """What the flights of a case passed through: seconds near the floor, the ceiling, under the other
    vehicle; speed, thrust.
    """
    low = high = wake = 0.0
    speeds, demands = [], []
    for bodies, ticks in zip(flights.of_flight[index], flights.ticks[index], strict=True):
        for j in bodies:
            z = flown["position"][:ticks, 2, j]
            low += 0.01 * float((z < 0.15).sum())
            high += 0.01 * float((z > body.CEILING - 0.15).sum())
            speeds.append(np.sqrt((flown["velocity"][:ticks, :, j].astype(float) ** 2).sum(axis=1)))
            demands.append(flown["motor"][:ticks, :, j].max(axis=1))
            other = flights.partner[j]
            if other != j:
                apart = flown["position"][:ticks, :, other] - flown["position"][:ticks, :, j]
                wake += 0.01 * float(
                    (
                        (apart[:, 2] > 0.03)
                        & (apart[:, 2] < 0.7)
                        & (np.hypot(apart[:, 0], apart[:, 1]) < 0.12)
                    ).sum()
                )
    return {
        "below_15cm_s": round(low, 2),
        "within_15cm_of_ceiling_s": round(high, 2),
        "in_wake_s": round(wake, 2),
        "speed_rms": round(float(np.sqrt(np.mean(np.concatenate(speeds) ** 2))), 3),
        "motor_99": round(float(np.percentile(np.concatenate(demands), 99)), 3),
    }


def floor():
    """The published noise floor per channel of `replay.CHANNELS`."""
    stored = json.loads(FLOOR_FILE.read_text())["floor"]
    return np.array([stored[c] for c in replay.CHANNELS])


def severity(with_cause, without, level):
    """Rms change per channel over the floor, (12, cases): what the cause adds to the replay error."""
    return np.sqrt(np.maximum(with_cause**2 - without**2, 0.0)) / level[:, None]


def limits(effect):
    smallest, _, largest = causes.LIMITS.get(effect, (0.005, 1.0, 8.0))
    return smallest, largest


def calibrate(flights, causes_of, targets, rounds=3):
    """Move each case's single cause to its target severity, by secants in logarithms; the size that came
    nearest is kept. Sizes stay within `causes.LIMITS`, whatever the target.
    """
    level = floor()
    nominal, _ = flights.fly([[] for _ in causes_of])
    without = flights.rms(replay.errors(nominal, TICKS), nominal)
    tried = [[] for _ in causes_of]  # (log size, log reached) per case
    for number in range(rounds):
        flown, _ = flights.fly(causes_of)
        reached = severity(flights.rms(replay.errors(flown, TICKS), flown), without, level).max(axis=0)
        for i, own in enumerate(causes_of):
            if not own or targets[i] is None:
                continue
            crashed = (flown["crashed"][flights.columns[i]] < TICKS).any()
            tried[i].append((np.log(own[0]["size"]), np.log(max(reached[i], 0.02)), crashed))
            if number < rounds - 1:
                moved = np.exp(_next(tried[i], np.log(targets[i])))
                own[0]["size"] = float(np.clip(moved, *limits(own[0]["effect"])))
    for i, own in enumerate(causes_of):
        if tried[i]:
            # a crash ends the search on that side
            best = min(tried[i], key=lambda t: abs(t[1] - np.log(targets[i])) + 10 * t[2])
            own[0]["size"] = float(np.exp(best[0]))


def _next(tried, target):
    """Next log size from the (log size, log reached, crashed) tried so far."""
    size, reached, crashed = tried[-1]
    if crashed:
        return size - 0.6
    slope = 1.0
    if len(tried) > 1 and abs(size - tried[-2][0]) > 0.05:
        slope = np.clip((reached - tried[-2][1]) / (size - tried[-2][0]), 0.5, 4.0)
    return size + np.clip((target - reached) / slope, -2.0, 1.8)
