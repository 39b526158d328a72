"""Plans of set-points as CSV files: rows of 10 ms, for `openjax fly --plan` and for Crazyswarm2.

Columns: t (s); x, y, z (m), vx, vy, vz (m/s), ax, ay, az (m/s^2), world; yaw (rad), as
Crazyswarm2's `cmdFullState` takes them; then what is added to the commands of a controller of
thrust and body rates: thrust (share of the largest), wx, wy, wz (rad/s); segment's name.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from openjax.errors import UserError
from openjax.files import write_text
from openjax.flights.manoeuvres import PERIOD
from openjax.flights.segments import SEGMENTS

COLUMNS = tuple("t x y z vx vy vz ax ay az yaw thrust wx wy wz segment".split())
STANDARD = "identify"
"""The name of the plan of all segments."""
FARTHEST = 100.0  # of any number in a plan


@dataclass(frozen=True, eq=False)
class SetPoints:
    """T rows of 10 ms."""

    position: np.ndarray  # (T, 3) m
    velocity: np.ndarray  # (T, 3) m/s
    acceleration: np.ndarray  # (T, 3) m/s^2
    yaw: np.ndarray  # (T,) rad
    extra: np.ndarray  # (T, 4) added to thrust and body rates
    segment: tuple[str, ...]  # (T,) to which each belongs

    def __len__(self) -> int:
        return len(self.yaw)


def plan_of(segments: Iterable[str] = tuple(SEGMENTS)) -> SetPoints:
    """The set-points of segments, one after the other."""
    position = []
    yaw = []
    extra = []
    names = []
    for name in segments:
        reference = SEGMENTS[name].reference()
        position.append(reference.position[:, 0])
        yaw.append(reference.yaw[:, 0])
        extra.append(reference.extra_command[:, 0])
        names += [name] * len(reference.yaw)
    place = np.concatenate(position)
    velocity = np.gradient(place, PERIOD, axis=0)
    acceleration = np.gradient(velocity, PERIOD, axis=0)
    return SetPoints(
        position=place,
        velocity=velocity,
        acceleration=acceleration,
        yaw=np.concatenate(yaw),
        extra=np.concatenate(extra),
        segment=tuple(names),
    )


def write_plan(path: Path, plan: SetPoints) -> None:
    """Write a plan's CSV."""
    time = PERIOD * np.arange(len(plan))
    numbers = np.column_stack(
        [time, plan.position, plan.velocity, plan.acceleration, plan.yaw, plan.extra]
    )
    lines = [",".join(COLUMNS)]
    for row, name in zip(numbers, plan.segment, strict=True):
        lines.append(",".join([*(f"{v:.4f}" for v in row), name]))
    write_text(path, "\n".join(lines) + "\n")


def read_plan(name_or_path: str | Path) -> SetPoints:
    """The standard plan by its name, or a plan's CSV. Raises UserError where that can't
    be flown.
    """
    # a file that somebody called so is what they mean
    if str(name_or_path) == STANDARD and not Path(name_or_path).exists():
        return plan_of()
    path = Path(name_or_path)
    if not path.is_file():
        raise UserError(f"{path}: no such plan; {STANDARD!r} or a CSV of openjax plan is needed")
    lines = path.read_text(encoding="utf-8").splitlines()
    if not lines or tuple(lines[0].split(",")) != COLUMNS:
        raise UserError(f"{path}: not a plan; its first line must be {','.join(COLUMNS)}")
    cells = [line.split(",") for line in lines[1:] if line]
    if not cells:
        raise UserError(f"{path}: a plan without rows; write one with openjax plan")
    try:
        numbers = np.array([row[:-1] for row in cells], float)
    except ValueError:
        raise UserError(f"{path}: a plan has {len(COLUMNS) - 1} numbers in every row") from None
    if numbers.shape[1] != len(COLUMNS) - 1:
        raise UserError(f"{path}: a plan has {len(COLUMNS) - 1} numbers in every row")
    if not (np.abs(numbers[:, 1:]) < FARTHEST).all():
        raise UserError(f"{path}: a number of the plan is not finite or beyond {FARTHEST:g}")
    if not np.allclose(np.diff(numbers[:, 0]), PERIOD, atol=1e-3):
        raise UserError(f"{path}: a plan's rows must be {1e3 * PERIOD:g} ms apart")
    return SetPoints(
        position=numbers[:, 1:4],
        velocity=numbers[:, 4:7],
        acceleration=numbers[:, 7:10],
        yaw=numbers[:, 10],
        extra=numbers[:, 11:15],
        segment=tuple(row[-1] for row in cells),
    )
