"""Cases flown in RotorPy by vehicles that know where they are from an on-board estimator, and log what it says.

    python -m experiments.diagnosis.onboard_cases --seed 1 --each 2 --logs LOGS --answers ANSWERS.json [--jobs 8]

Vehicle, causes and trajectories are those of `rotorpy_cases`; estimators and loops are `onboard`'s, and the vehicle is
flown on the estimate. So the log's pose lags, jumps where a position comes in, leans with the accelerometer's bias, and its
velocity is no derivative of its position. Beside the causes of `rotorpy_cases` there are weak rotors, thrust curves,
sagging batteries, and unknown kinds that are local in time or place. Seeds from 50 on are for reported runs.
"""

import argparse

import numpy as np

from experiments.diagnosis import measure, sensors
from experiments.diagnosis import rotorpy_cases as rp
from experiments.diagnosis import vehicle as v
from experiments.diagnosis.flown_cases import (
    answer,
    choose_paths,
    fly_plan,
    slow_enough,
    told_for,
    write_case,
)
from experiments.diagnosis.generate import add_case_arguments
from experiments.diagnosis.onboard_flight import STEP, fly

SECONDS, SHORT = 8.0, 4.0  # of a flight; at 500 rows a second
FINISH = 4.0  # s that a flight must last
# where positions come from: (deviation m, rate Hz, how late at most s)
SOURCES = {
    "mocap": ((4e-4, 1.5e-3), (60.0, 100.0), 0.006),
    "lighthouse": ((2e-3, 8e-3), (30.0, 50.0), 0.004),
    "uwb": ((0.03, 0.08), (70.0, 100.0), 0.003),
    "flow": ((0.03, 0.1), (50.0, 100.0), 0.004),  # deviation in m/s; heights are good to 3 mm
}
KINDS = ("kalman_mocap", "kalman_pose", "kalman_lighthouse", "kalman_uwb", "kalman_flow", "mahony_mocap")
SHARES = (0.2, 0.2, 0.2, 0.12, 0.1, 0.18)
RATES = {50: 0.12, 100: 0.53, 250: 0.15, 500: 0.2}
TURBULENCE = {"none": (0.0, 0.05), "light": (0.3, 1.2), "strong": (2.0, 4.0)}  # mN rms


def _imbalance(rng, told, hover):
    e = np.zeros(4)
    e[rng.integers(4)] = -rng.uniform(0.04, 0.15)
    return {"rotors": 1 + e}, None, {"e": e.tolist()}


def _curve(rng, told, hover):
    return {"power": float(rng.choice([rng.uniform(0.7, 0.88), rng.uniform(1.15, 1.35)]))}, None, {}


def _sag(rng, told, hover):
    k = rng.uniform(0.2, 0.45)
    return {"per_volt": k}, None, {"thrust_per_volt": k, "reference_voltage": 3.7}


def _local(kind):
    return lambda rng, told, hover: ({"local": kind}, None, {})


def _both(one, two):
    def draw(rng, told, hover):
        (a, wind, said), (b, other, too) = one(rng, told, hover), two(rng, told, hover)
        return a | b, wind or other, [said, too]

    return draw


CAUSES = {k: x for k, x in rp.KINDS.items() if k not in ("noisy_motors", "translational_lift", "wind_tunnel")}
CAUSES |= {
    "motor_imbalance": (_imbalance, ["motor_imbalance"], "one_weak", ()),
    "thrust_curve": (_curve, ["thrust_curve"], "power", ("circle", "eight")),
    "battery_sag": (_sag, ["battery_sag"], "linear", ()),
    "mass_and_offset": (_both(rp._mass, rp._offset), ["mass", "com_offset"], ("plain", "torque"), ()),
    "drag_and_inertia": (
        _both(rp._drag, rp._inertia),
        ["rotor_drag", "inertia"],
        ("rotor_speed", "diagonal"),
        rp.TURNS,
    ),
}
LOCAL = ("kicks", "jet", "late_fault", "hiccups", "pulses")
CAUSES |= {k: (_local(k), ["unknown"], "outside", rp.LAPS if k == "jet" else ()) for k in LOCAL}
FINE = {"late_fault": ["motor_imbalance"], "hiccups": ["motor_imbalance"], "jet": ["wind"]}
WEIGHTS = {"none": 4, "inertia": 2, "thrust_curve": 2}  # how often more than others


def draw_sensors(rng, needed, commanded):
    """Estimator, sensors and log of a case: plain values, with the keys that the scorer reads."""
    kind = str(rng.choice(KINDS, p=SHARES))
    way = kind.split("_")[1]
    deviation, rates, late = SOURCES["mocap" if way == "pose" else way]
    good = float(np.exp(rng.uniform(np.log(0.5), np.log(2.0))))
    turbulence = str(rng.choice(list(TURBULENCE), p=[0.4, 0.4, 0.2]))
    chance = {"p": 1.0, "s": 0.75, "g": 0.93, "a": 0.85, "m": 0.95, "v": 0.8, "c": float(commanded)}
    have = set(needed) | {c for c, p in chance.items() if rng.random() < p}
    have |= set() if have & {"c", "m"} else {"m"}
    filtered = rng.random() < 0.5
    return {
        "kind": kind,
        "rate": int(rng.choice(list(RATES), p=list(RATES.values()))),
        "channels": "".join(sorted(have)),
        "turbulence": turbulence,
        "gust": float(rng.uniform(*TURBULENCE[turbulence])),
        "gust_time": float(rng.uniform(0.08, 0.4)),
        "deviation": float(rng.uniform(*deviation)),
        "source_rate": float(rng.uniform(*rates)),
        "late": float(rng.uniform(0, late)),
        "lost": float(rng.choice([0.0, 0.01, 0.03])),  # chance that a drop-out begins with a measurement
        "believed": float(
            np.exp(rng.uniform(np.log(0.6), np.log(1.8)))
        ),  # deviation in the filter over the true one
        "caution": float(rng.uniform(1.0, 4.0)),  # the same of the IMU's noise
        "plumb": float(np.exp(rng.uniform(np.log(0.05), np.log(0.4)))),
        "follow": float(rng.uniform(4.0, 15.0)),
        "gyro": 0.012 * good,
        "accel": 0.2 * good,
        "gyro_bias": rng.normal(0, 0.003, 3).tolist(),
        "accel_bias": rng.normal(0, 0.08, 3).tolist(),
        "gyro_cut": 80.0 if filtered else 0.0,
        "accel_cut": 30.0 if filtered else 0.0,
        "slope_time": float(rng.choice([0.0, 0.0, 0.003])),
        "gains": [rng.uniform(5, 11), rng.uniform(3.5, 5.5), rng.uniform(7, 12), rng.uniform(2, 5)],
        "thrust_offset": float(rng.uniform(-0.008, 0.008)),
        "constants_off": rng.uniform(-0.01, 0.01, 5).tolist(),
        "motor": "snapshot" if rng.random() < 0.5 else "mean",
        "dropped": float(rng.choice([0.0, 0.0, 0.01, 0.03])),
        "quantum": 1.0,
        "voltage": float(rng.uniform(3.6, 4.05)),
    }


def log_rows(rng, drawn, flown, seconds):
    """Rows of the log, dict column -> (n,): what estimator, sensors and loops hold when a row is written."""
    every = round(1 / (STEP * drawn["rate"]))
    place = np.arange(0, int(seconds / STEP) - every, every)
    keep = rng.random(len(place)) >= drawn["dropped"]
    keep[:3] = True
    place = place[keep]
    motor = flown["motor"][:, :, 0].astype(float)
    motors = (
        motor[place]
        if drawn["motor"] == "snapshot"
        else np.stack([motor[i : i + every].mean(0) for i in place])
    )
    voltage = flown["voltage"][place, 0] + 0.01 * rng.standard_normal(len(place))
    voltage[np.arange(len(place)) % max(drawn["rate"] // 10, 1) != 0] = np.nan
    groups = [
        flown[k][place, :, 0] for k in ("said_position", "said_quaternion", "said_velocity", "gyro", "accel")
    ]
    groups += [flown["command"][place // 5, :, 0], motors, voltage[:, None]]
    values = np.concatenate([g.astype(float) for g in groups], axis=1)
    return {"t": STEP * place} | dict(zip(sensors.COLUMNS[2:], values.T, strict=True))


def air_errors(joined):
    """Mean squares (12,) that the air alone adds to the errors of `measure`."""
    out = np.zeros(12)
    for columns, horizon in ((slice(0, 3), measure.LONG), (slice(3, 6), measure.SHORT)):
        whole = np.cumsum(joined["gusts"][:, columns], axis=0) * STEP
        out[columns] = ((whole[horizon:] - whole[:-horizon]) ** 2).mean(axis=(0, 2))
    return out


def make_case(job):
    """Fly and write one case; returns its answer."""
    seed, number, kind, folder = job
    rng = np.random.default_rng(np.random.SeedSequence([29, seed, number]))
    draw, effects, form, exposing = CAUSES[kind]
    told = told_for(rng, effects)
    changed, wind, said = draw(rng, told, v.MAX_SPEED * np.sqrt(told.hover))
    torque = {"inertia", "yaw_torque", "motor_lag"} & set(effects)
    needed = "pgm" + ("v" if "battery_sag" in effects else "") if effects else ""
    drawn = draw_sensors(rng, needed, bool(torque) or rng.random() < 0.75)
    off = 1 + np.array(drawn["constants_off"])
    untold = {
        "k_eta": told.thrust_constant * (1 + drawn["thrust_offset"]),
        "tau_m": told.motor_time * (1 + 3 * (off[0] - 1)),
    }
    untold["k_m"] = told.torque_ratio * untold["k_eta"] * off[1]
    untold |= dict(zip(("Ixx", "Iyy", "Izz"), np.array(told.inertia) * off[2:], strict=True))
    names = choose_paths(rng, exposing, ("circle", "eight", "rocking", "yawing", "hover"))
    seconds = SHORT if drawn["rate"] >= 500 else SECONDS
    flights, flown = [], []
    for name in names:

        def attempt(slower, name=name):
            return fly(told, untold | changed, wind, rp.trajectory(name, rng, slower), drawn, rng, seconds)

        flight = slow_enough(attempt, min(FINISH, seconds - 0.1) / STEP)
        flown.append(flight)
        flights.append([log_rows(rng, drawn, flight, max(STEP * flight["crashed"][0] - 0.05, 0.5))])
    joined = {k: np.concatenate([f[k] for f in flown], axis=-1) for k in flown[0]}
    vehicle = v.toml(told, "RotorPy 3, on-board estimate", drawn["rate"])
    place = write_case(folder, number, flights, drawn, vehicle)
    controller = "rates" if "c" in drawn["channels"] else "SE3Control"
    return answer(
        place.name,
        kind,
        told,
        drawn,
        names,
        joined,
        flights,
        effects,
        form,
        said,
        controller,
        FINE.get(kind, []),
        air_errors(joined),
        drawn["constants_off"],
    )


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    add_case_arguments(parser)
    parser.add_argument("--each", type=int, default=2, help="cases of each kind")
    parser.add_argument("--kinds", default=",".join(CAUSES))
    options = parser.parse_args()
    kinds = [k for k in options.kinds.split(",") for _ in range(options.each * WEIGHTS.get(k, 1))]
    fly_plan(options, kinds, make_case, "onboard")


if __name__ == "__main__":
    main()
