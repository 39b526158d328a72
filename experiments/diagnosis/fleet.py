"""Cases in the air and on disk: many variants of them flown as one batch, measured, and their logs
written.
"""

import gzip

import numpy as np

from experiments.diagnosis import (
    cases,
    effects,
    garbage,
    injection,
    measure,
    plant,
    real,
    sensors,
    unknowns,
    vehicle,
)
from experiments.diagnosis.rows import log_rows

VOCABULARY = list(effects.EFFECTS)
LINK = ("command_latency", "packet_loss")  # effects that the commands in force tell
FIRMWARE = (*LINK, "rate_gains")


def bodies(seed, column, spec):
    """Reference, air and partner of each of a case's bodies, flight by flight."""
    rng = cases.case_rng(seed, column, spec["number"], 1)
    out = []
    for mission in spec["missions"]:
        voltage = spec["sensors"]["voltage"] + rng.uniform(-0.15, 0.1)
        references = cases.reference_of(rng, mission, cases.TICKS)
        here = list(range(len(out), len(out) + len(references)))
        for i, reference in enumerate(references):
            air = sensors.draw_air(
                rng, spec["sensors"], cases.TICKS, voltage + rng.uniform(-0.02, 0.02)
            )
            out.append((reference, air, here[::-1][i] if len(here) == 2 else here[i]))
    return out


class Fleet:
    """Bodies of several variants of several cases, flown as one batch."""

    def __init__(self, seed, column, variants, drawn, wakes_from=None):
        """variants: list of (spec, causes); drawn: {case name: `bodies`}; `wakes_from` as in
        `plant.Batch`.
        """
        self.seed = seed
        self.column = column
        self.variants = variants
        told = []
        references = []
        airs = []
        partner = []
        kinds = []
        logged = []
        self.columns = []
        for spec, _ in variants:
            start = len(told)
            for reference, air, other in drawn[spec["name"]]:
                told.append(spec["told"])
                references.append(reference)
                airs.append(air)
                partner.append(start + other)
                kinds.append(spec["controller"])
            for mission, ticks in zip(spec["missions"], spec["ticks"], strict=True):
                logged += [plant.PER_TICK * ticks] * (2 if len(mission) == 2 else 1)
            self.columns.append(np.arange(start, len(told)))
        self.told, self.partner = told, np.array(partner)
        arrival = np.repeat(10 * np.arange(cases.TICKS)[:, None], len(told), axis=1)
        self.parameters, strangers, self.magnitudes = self.model([c for _, c in variants], arrival)
        reference = {k: np.stack([r[k] for r in references], axis=-1) for k in references[0]}
        air = sensors.stack(airs)
        batch = plant.Batch(
            told, self.parameters, reference, kinds, self.partner, arrival, air, strangers
        )
        if wakes_from is not None:
            batch.wakes_from = wakes_from
        self.flown = plant.fly(batch)
        # What is measured is what the logs cover: a fault that comes after their end shows nothing.
        self.seen = self.flown | {"crashed": np.minimum(self.flown["crashed"], logged)}

    def model(self, causes_of, arrival=None):
        """Parameters with the nuisances and these causes; unknown causes and magnitudes beside."""
        p = vehicle.nominal_parameters(self.told)
        strangers = {}
        magnitudes = []
        scratch = np.zeros((cases.TICKS, len(self.told)), int) if arrival is None else arrival
        for (spec, _), columns, own in zip(self.variants, self.columns, causes_of, strict=True):
            sensors.apply_nuisances(p, columns, spec["sensors"])
            real.apply(spec.get("form_errors"), p, columns)
            p["rotor_gain"][:, columns] *= np.array(spec.get("day", np.ones(4)))[:, None]
            said = []
            for i, cause in enumerate(own):
                rng = cases.case_rng(self.seed, self.column, spec["number"], 2, i)
                if cause["effect"] in VOCABULARY:
                    said.append(injection.inject(cause, p, columns, scratch, rng))
                else:
                    strangers.setdefault(cause["effect"], []).append((columns, cause))
                    said.append({"strength": cause["size"], "unit": cause["unit"]})
            magnitudes.append(said)
        return p, strangers, magnitudes

    def errors(self, causes_of):
        """Mean squares (12, variants) of the model with these causes."""
        links, firmware = np.zeros((2, len(self.told)), bool)
        for (_, flew), columns, own in zip(self.variants, self.columns, causes_of, strict=True):
            links[columns] = any(c["effect"] in LINK for c in own)
            firmware[columns] = any(c["effect"] in FIRMWARE and c not in own for c in flew)
        known = [[c for c in own if c["effect"] in VOCABULARY] for own in causes_of]
        parameters = self.model(known)[0]
        rms = measure.errors(self.seen, self.told, parameters, self.partner, firmware, links)
        return np.stack([(rms[:, c] ** 2).mean(axis=1) for c in self.columns], axis=1)

    def replayed(self, i, parameters, motors=None, lasts=None):
        """Mean squares (12,) of a model on variant i alone, driven by other motor commands (S, 4,
        n) than it got, if given; `lasts` (n,): samples of them.
        """
        c = self.columns[i]
        no = np.zeros(len(self.columns[i]), bool)
        flown = {k: x[..., c] for k, x in self.flown.items()}
        if motors is not None:
            flown |= {"motor": motors, "crashed": np.minimum(flown["crashed"], lasts)}
        told = [self.told[j] for j in c]
        own = {k: x[..., c] for k, x in parameters.items()}
        return (measure.errors(flown, told, own, self.partner[c] - c[0], no, no) ** 2).mean(axis=1)

    def energies(self):
        """{model: mean squares (12, variants)}: the nominal model, the true one, and that without
        its first or second cause.
        """
        flew = [own for _, own in self.variants]
        out = {"nominal": self.errors([[] for _ in flew]), "truth": self.errors(flew)}
        if any(len(own) > 1 for own in flew):
            out |= {i: self.errors([own[:i] + own[i + 1 :] for own in flew]) for i in (0, 1)}
        return out

    def lasts(self, i):
        """Share of the longest flight that every body of variant i stays in the air."""
        return float(self.flown["crashed"][self.columns[i]].min() / (5 * cases.TICKS))

    def _log(self, rng, spec, body, ticks, sensed):
        """The rows of one body, motors as its vehicle commands them."""
        rows = log_rows(rng, spec["sensors"], self.flown, body, ticks, sensed, spec["told"].hover)
        return real.as_logged(spec.get("form_errors"), spec["told"], rows)

    def rows(self, i, spoiled=False):
        """The log of variant i: list over flights of lists over vehicles of {column: (n,)}, and the
        rows that are wrong.
        """
        spec, causes = self.variants[i]
        rng = cases.case_rng(self.seed, self.column, spec["number"], 3)
        sensed = [c for c in causes if c["effect"] in unknowns.SENSOR_SITES]
        out = []
        j = self.columns[i][0]
        for mission, ticks in zip(spec["missions"], spec["ticks"], strict=True):
            bodies = range(j, j + (2 if len(mission) == 2 else 1))
            ticks = int(min([ticks] + [self.flown["crashed"][b] // 5 - 5 for b in bodies]))
            out.append([self._log(rng, spec, b, ticks, sensed) for b in bodies])
            j = bodies[-1] + 1
        wrong = []
        if spoiled and spec["garbage"]:
            wrong = garbage.spoil(spec["garbage"], [f[0] for f in out], rng)
            wrong = [
                c for c in wrong if any(c in sensors.GROUPS[g] for g in spec["sensors"]["channels"])
            ]
        return out, wrong


def write_flight(path, vehicles, channels):
    """One gzipped CSV file in the format of the flight logs; the same rows give the same bytes."""
    columns = [c for g in "psgacmv" if g in channels for c in sensors.GROUPS[g]]
    lines = []
    line = ",".join(f"%.{sensors.DECIMALS[c]}f" for c in columns)
    for i, rows in enumerate(vehicles):
        table = np.stack([rows[c] for c in columns], axis=1).tolist()
        times = rows["t"].tolist()
        lines += [(t, f"{t:.4f},{i}," + line % tuple(r)) for t, r in zip(times, table, strict=True)]
    lines.sort(key=lambda entry: entry[0])
    text = (
        "\n".join([",".join(["t", "vehicle", *columns]), *(x.replace("nan", "") for _, x in lines)])
        + "\n"
    )
    with open(path, "wb") as raw, gzip.GzipFile("", "wb", 6, raw, mtime=0) as packed:
        packed.write(text.encode())


def write_logs(folder, flights, channels, vehicle_file):
    """Write a case's three logs and the text of its `vehicle.toml`."""
    folder.mkdir(parents=True, exist_ok=True)
    for letter, flight in zip("abc", flights, strict=True):
        write_flight(folder / f"flight_{letter}.csv.gz", flight, channels)
    (folder / "vehicle.toml").write_text(vehicle_file)


def write_case(fleet, i, folder, spoiled=False):
    """Write the logs and `vehicle.toml` of variant i into `folder`; returns the columns that were
    spoiled.
    """
    spec, (rows, wrong) = fleet.variants[i][0], fleet.rows(i, spoiled)
    errors = spec.get("form_errors")
    command = "pwm" if errors and errors["pwm"] else "thrust"
    told = vehicle.toml(spec["told"], "simulated", spec["sensors"], command)
    write_logs(folder, rows, spec["sensors"]["channels"], told)
    return wrong
