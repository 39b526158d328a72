"""Cases flown in the withheld plant: which missions, which parameters, and the logs that are written of them."""

import gzip
import io

import numpy as np

from experiments.withheld import body, causes, missions, plant, sensors

TICKS = 1200

VEHICLE = """[vehicle]
name = "crazyflie-2.1"
mass = 0.03210
mass_weighed = {weighed}

[motor]
command = "thrust"
order = ["front_right", "rear_right", "rear_left", "front_left"]
spin = ["ccw", "cw", "ccw", "cw"]

[log]
source = "simulated, cause withheld"
motion_capture_rate = 100
"""


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
            spec["thrust_offset"] = shared["thrust_offset"]
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
        magnitudes = []
        for spec, columns, own in zip(self.specs, self.columns, causes_of, strict=True):
            p["rotor_gain"][:, columns] *= 1 + spec["thrust_offset"]
            magnitudes.append(
                [
                    causes.apply(cause, p, columns, arrival, case_rng(self.seed, spec["number"], 2, i))
                    for i, cause in enumerate(own)
                ]
            )
        flown = plant.fly(plant.Batch(p, self.reference, self.partner, arrival, self.noise))
        return flown, magnitudes


def write_case(folder, spec, flights, flown, index):
    """Write flight_{a,b,c}.csv.gz and vehicle.toml of one case; returns the number of rows of each flight."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "vehicle.toml").write_text(VEHICLE.format(weighed="true" if spec["mass_weighed"] else "false"))
    formats = [f"%.{d}f" for d in sensors.DECIMALS]
    lengths = []
    for letter, bodies, ticks in zip("abc", flights.of_flight[index], flights.ticks[index], strict=True):
        ticks = min([ticks] + [int(flown["crashed"][j]) - 5 for j in bodies])
        rows = [sensors.log_rows(flown, flights.noise, j, ticks) for j in bodies]
        text = io.StringIO()
        text.write(",".join(sensors.COLUMNS) + "\n")
        line = ",".join(formats)
        for k in range(ticks):
            for vehicle, values in enumerate(rows):
                text.write(f"{0.01 * k:.2f},{vehicle}," + (line % tuple(values[k])).replace("nan", "") + "\n")
        # mtime 0: the same seed gives the same bytes
        with (
            open(folder / f"flight_{letter}.csv.gz", "wb") as raw,
            gzip.GzipFile("", "wb", 6, raw, mtime=0) as packed,
        ):
            packed.write(text.getvalue().encode())
        lengths.append(ticks)
    return lengths
