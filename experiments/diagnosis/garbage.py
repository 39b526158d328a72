"""Logs that contradict themselves: what people really hand in. Each takes the rows of a case's
flights and spoils them.

`KINDS` may be used for development; `STRANGERS` appear in reported runs only.
"""

import numpy as np

from experiments.diagnosis.sensors import COLUMNS, GROUPS

GYRO = GROUPS["g"]
ACCEL = GROUPS["a"]
MOTOR = GROUPS["m"]
RATES = GROUPS["c"][1:]
# kind -> channel groups that it needs
KINDS = {
    "noise_everywhere": "",
    "shuffled_gyro": "g",
    "shuffled_motors": "mg",
    "swapped_gyro_axes": "pg",
    "swapped_position_axes": "pa",
    "motor_order": "mg",
    "other_flight_gyro": "pg",
    "other_flight_motors": "mg",
    "gyro_in_degrees": "pg",
    "flipped_gyro_axis": "pg",
    "quaternion_order": "pg",
}
STRANGERS = {
    "frozen_gyro": "pg",
    "late_imu": "pga",
    "mirrored_pose": "pg",
    "inverted_quaternion": "pg",
    "accelerometer_in_g": "pa",
    "other_flight_pose": "pg",
}


def spoil(kind, flights, rng):
    """Spoil `flights` (list of {column: (n,)} of one vehicle) in place; returns the columns that
    are wrong.
    """
    a, b, _ = rng.permutation(3)
    order = rng.permutation(4)
    while np.array_equal(order, np.arange(4)):
        order = rng.permutation(4)
    if kind == "flipped_gyro_axis":  # an axis that hardly turns shows no flip
        turns = [np.mean([np.nanstd(f[c]) for f in flights]) for c in GYRO]
        a = a if turns[a] > 0.3 * max(turns) else int(np.argmax(turns))
    originals = [{k: v.copy() for k, v in f.items()} for f in flights]
    wrong = set()

    def put(f, columns, values):
        for column, value in zip(columns, values, strict=True):
            f[column] = value
            wrong.add(column)

    for i, f in enumerate(flights):
        n = len(f["t"])
        other = originals[(i + 1) % len(flights)]
        if kind == "noise_everywhere":
            for column in COLUMNS[2:]:
                if column in f:
                    spread = np.nanstd(f[column]) + 1e-3
                    put(f, [column], [np.nanmean(f[column]) + spread * rng.standard_normal(n)])
        elif kind in ("shuffled_gyro", "shuffled_motors"):
            columns = GYRO if kind == "shuffled_gyro" else MOTOR
            rows = rng.permutation(n)
            put(f, columns, [f[c][rows] for c in columns])
        elif kind == "swapped_gyro_axes":
            put(f, [GYRO[a], GYRO[b]], [f[GYRO[b]], f[GYRO[a]]])
        elif kind == "swapped_position_axes":
            for group in (["x", "z"], ["vx", "vz"]):
                if group[0] in f:
                    put(f, group, [f[group[1]], f[group[0]]])
        elif kind == "motor_order":
            put(f, MOTOR, [f[MOTOR[k]] for k in order])
        elif kind.startswith("other_flight"):
            columns = {"gyro": GYRO, "motors": MOTOR, "pose": GROUPS["p"] + GROUPS["s"]}[
                kind.split("_")[-1]
            ]
            columns = [c for c in columns if c in f]
            put(f, columns, [np.resize(other[c], n) for c in columns])
        elif kind == "gyro_in_degrees":
            put(f, GYRO, [np.rad2deg(f[c]) for c in GYRO])
        elif kind == "flipped_gyro_axis":
            put(f, [GYRO[a]], [-f[GYRO[a]]])
        elif kind == "quaternion_order":
            names = ["qw", "qx", "qy", "qz"]
            put(f, names, [f[c] for c in ("qx", "qy", "qz", "qw")])
        elif kind == "inverted_quaternion":
            put(f, ["qx", "qy", "qz"], [-f[c] for c in ("qx", "qy", "qz")])
        elif kind == "frozen_gyro":
            stop = n // 3
            put(f, GYRO, [np.where(np.arange(n) < stop, f[c], f[c][stop]) for c in GYRO])
        elif kind == "late_imu":
            shift = int(np.searchsorted(f["t"], 0.3 + 0.3 * (a + 1) / 3))
            columns = GYRO + ACCEL
            put(
                f,
                columns,
                [np.concatenate([np.repeat(f[c][:1], shift), f[c][:-shift]]) for c in columns],
            )
        elif kind == "mirrored_pose":
            put(f, [c for c in ("y", "vy") if c in f], [-f[c] for c in ("y", "vy") if c in f])
            put(f, ["qx", "qz"], [-f["qx"], -f["qz"]])
        elif kind == "accelerometer_in_g":
            put(f, ACCEL, [f[c] / 9.81 for c in ACCEL])
        else:
            raise ValueError(f"unknown kind {kind!r}")
    return sorted(wrong, key=COLUMNS.index)
