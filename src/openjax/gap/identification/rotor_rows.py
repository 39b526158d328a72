"""Rotors along rows of motor commands: delay and lag solved exactly within every row.

The rotor model is the simulator's (`openjax.vehicle.rotors`): T dw/dt = w_commanded - w, thrust in
proportion to w^2, T different for speeding up and slowing down. A row's command holds until the
next row.
"""

import jax
import jax.numpy as jnp
import numpy as np

SMALLEST = 1e-8  # of a command: the square root's slope stays finite


@jax.jit
def _scan(first, second, up, down, spans):
    """Speeds, as shares of the largest, whose targets in the two parts of a row, `spans` (2,) s
    long, are `first` and `second` (T, 4): mean square over each row, and speed at its end.
    """

    def part(speed, target, span):
        constant = jnp.where(target < speed, down, up)
        kept = jnp.exp(-span / constant)
        off = speed - target
        square = target * target * span + off * constant * (
            2.0 * target * (1.0 - kept) + 0.5 * off * (1.0 - kept * kept)
        )
        return target + off * kept, square

    def row(speed, targets):
        speed, before = part(speed, targets[0], spans[0])
        speed, after = part(speed, targets[1], spans[1])
        return speed, ((before + after) / spans.sum(), speed)

    return jax.lax.scan(row, first[0], (first, second))[1]


_batched = jax.jit(jax.vmap(_scan))


def rotor_rows(commands: np.ndarray, dt: float, lags: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean thrust of each row (B, T, 4) and speed at its end (B, T, 4), as shares of the largest,
    for commands (T, 4) in rows of dt s and B `lags` (B, 3): time constants of speeding up and of
    slowing down, and delay, s.
    """
    wanted = np.sqrt(np.clip(commands, SMALLEST, None))
    rows = np.arange(len(wanted))
    whole = np.floor(lags[:, 2] / dt).astype(int)
    late = lags[:, 2] - whole * dt
    size = 1 << (len(wanted) - 1).bit_length()  # few lengths, few compilations
    padded = np.minimum(np.arange(size), len(wanted) - 1)
    first, second = (
        np.stack([wanted[np.clip(rows - w, 0, len(rows) - 1)][padded] for w in whole + more])
        for more in (1, 0)
    )
    spans = np.stack([late, dt - late], 1)
    arrays = (first, second, lags[:, 0], lags[:, 1], spans)
    square, speed = _batched(*(a.astype(np.float32) for a in arrays))
    count = len(wanted)
    return np.asarray(square, float)[:, :count], np.asarray(speed, float)[:, :count]
