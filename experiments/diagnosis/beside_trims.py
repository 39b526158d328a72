"""Cases of the column real whose cause stands beside rotors that differ or a centre of mass that is
off: `python -m experiments.diagnosis.beside_trims SEED OUT`, for seeds 80 and 85 (with references).
"""

import sys
from pathlib import Path

import numpy as np

from experiments.diagnosis import cases, effects, generate, sensors
from experiments.flying.single_thread import use_single_thread

TRIMS = ("motor_imbalance", "com_offset")
STRONG = (3.0, 12.0)
MEDIUM = (3.0, 8.0)
# (cause or none, how many, its least and largest target in floors)
DRAWN = {
    80: (
        ("wind", 8, STRONG), ("ground_effect", 8, STRONG), ("downwash", 4, STRONG),
        ("rotor_drag", 4, MEDIUM), ("motor_lag", 4, MEDIUM), (None, 6, STRONG),
    ),
    85: (("wind", 5, STRONG), ("ground_effect", 5, STRONG), ("rotor_drag", 3, MEDIUM),
         (None, 3, STRONG)),
}  # fmt: skip


def draw(seed):
    """The seed's cases."""
    kinds = [(c, TRIMS[i % 2], t) for c, count, t in DRAWN[seed] for i in range(count)]
    return [case(seed, number, *kind) for number, kind in enumerate(kinds, 1)]


def case(seed, number, cause, trim, targets):
    """A case of the column, with these causes and with flights and channels that show them."""
    rng = np.random.default_rng([seed, number])
    category = "pair" if cause else "single"
    spec = cases.draw_case(seed, "real", number, category, number)
    names = [name for name in (cause, trim) if name]
    causes = [effects.draw(rng, name) for name in names]
    needed = [effects.EFFECTS[name].missions for name in names]
    flights = cases.draw_missions(rng, needed, spec["style"], cause == "downwash")
    kind = str(rng.choice(list(sensors.KINDS)))
    drawn = sensors.draw(
        rng,
        "filtered" if kind == "radio" else kind,
        "".join(effects.EFFECTS[name].needs for name in names),
    )
    most = 1000 if drawn["rate"] <= 250 else 500 if drawn["rate"] <= 500 else 400
    low, high = targets
    sizes = [low * (high / low) ** rng.uniform()] if cause else []
    return spec | {
        "category": category,
        "causes": causes,
        "targets": [*sizes, 30.0 * 2.0 ** rng.uniform()],
        "also_fine": cases.real.fine(spec["form_errors"], names),
        "missions": flights,
        "sensors": drawn,
        "ticks": [int(rng.integers(8 * most // 10, most + 1)) for _ in flights],
    }


def main(seed, out):
    """Fly them in lots of four, and write logs and answers."""
    use_single_thread()
    specs = draw(seed)
    answers = []
    for start in range(0, len(specs), 4):
        job = (seed, "real", specs[start : start + 4], out / f"own{seed}", seed == 85)
        answers += generate.fly_chunk(job)
    generate.write_answers(out / f"own{seed}_answers.json", answers, seed, "real")


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]))
