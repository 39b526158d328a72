"""What is local in frequency: no regressor predicts it, and yet it is no noise.

The rest is compared with the same flights' own spectrum, never with a plant's. Turbulence and sensors make smooth spectra; a
loose part, a pendulum or a beat makes a line. A vibrating sensor makes lines, too: what two sensors see at once is motion.
So does whoever flies circles: what any model has wrong comes back with each of them, and with its multiples.

Torques of a few hertz are how one flies; above, they are smooth, and whole flights tell weaker lines."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter
from scipy.signal import welch

from openjax.flights.track import Track
from openjax.gap.replay import FORCE, RATES, SKIP, VELOCITY

LINE = 10.0  # times the spectrum around it
ALONE = 30.0  # the same for a line that one sensor alone sees
PARTLY = 3.0  # of a line in a second sensor
QUICK, FAINT = 3.0, 20.0  # Hz above which torques of whole flights are looked at; times the spectrum around
SEGMENT, WHOLE = 4.0, 10.0  # s of a spectrum
AROUND = 3.0  # Hz whose median is the spectrum around
LOWEST, HIGHEST = 0.8, 25.0  # Hz
POSE_HIGHEST = 8.0  # Hz: above, what tracks the pose and puts it onto rows makes lines of its own
LAPS = 0.4  # of the velocity's power, near one frequency: the flights go round and round
LONGEST_LAP, MULTIPLES = 1.6, (1, 2)  # Hz; of it
NAMES = {"torque": RATES, "velocity": VELOCITY, "force": FORCE}


def lines(tracks: list[Track], disturbed: list[np.ndarray], usable: np.ndarray) -> tuple[str, ...]:
    """Findings in words. disturbed [(T, 9)]: what is left as accelerations, see `rest.disturbances`; usable (9,)."""
    seen = {name: axes for name, axes in NAMES.items() if usable[axes].any()}
    if len({round(t.dt, 5) for t in tracks}) > 1 or not seen:
        return ()
    spectra = {name: _ratio(tracks, [d[:, axes] for d in disturbed]) for name, axes in seen.items()}
    best, laps = {}, _laps(tracks)
    for name, (frequency, ratio) in spectra.items():
        inside = (frequency > LOWEST) & (frequency < (POSE_HIGHEST if name == "velocity" else HIGHEST))
        for lap in laps:
            for times in MULTIPLES:
                inside &= np.abs(frequency - times * lap) > 1.0 / SEGMENT
        place = np.unravel_index(np.argmax(np.where(inside[:, None], ratio, 0.0)), ratio.shape)
        best[name] = float(frequency[place[0]]), float(ratio[place]), "xyz"[place[1]]
    for name, (at, size, axis) in best.items():
        others = [
            n for n, (f, r) in spectra.items() if n != name and "torque" not in (n, name)
            and r[np.abs(f - at) < 1.5 / SEGMENT].max() > PARTLY
        ]  # fmt: skip
        # The pose is nobody's vibration; an accelerometer's or a gyroscope's line may be its own.
        alone = LINE if name == "velocity" else ALONE
        if (size > alone and (name != "force" or "velocity" not in seen)) or (size > LINE and others):
            return (_words(at, name, axis, size),)
    if "torque" in seen:
        frequency, ratio = _ratio(tracks, [d[:, RATES] for d in disturbed], WHOLE)
        ratio = np.where(((frequency > QUICK) & (frequency < HIGHEST))[:, None], ratio, 0.0)
        place = np.unravel_index(np.argmax(ratio), ratio.shape)
        if ratio[place] > FAINT:
            return (_words(frequency[place[0]], "torque", "xyz"[place[1]], ratio[place]),)
    return ()


def _words(at: float, name: str, axis: str, size: float) -> str:
    return f"a line at {at:.1f} Hz in {name} {axis}, {size:.0f} times the spectrum around it"


def _laps(tracks: list[Track]) -> list[float]:
    """Frequencies, Hz, at which the flights go round: of each track those that hold much of the velocity's power."""
    found = []
    for track in tracks:
        velocity = getattr(track, "velocity", None)
        if velocity is None:
            continue
        frequency, power = welch(velocity, 1.0 / track.dt, nperseg=len(velocity), axis=0, detrend="linear")
        power = power.sum(1)
        near = np.convolve(power, np.ones(3), "same") / power.sum()
        peaks = (power >= np.maximum(np.roll(power, 1), np.roll(power, -1))) & (near > LAPS)
        found += [float(f) for f in frequency[peaks & (frequency > 0.0) & (frequency < LONGEST_LAP)]]
    return found


def _ratio(tracks, parts, seconds: float = SEGMENT) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies (K,) Hz and the spectrum (K, 3) over its own median around."""
    total, weight = 0.0, 0.0
    kept = [part[int(SKIP / track.dt) :] for track, part in zip(tracks, parts, strict=True)]
    rows = min(round(seconds / tracks[0].dt), *(len(x) for x in kept)) // 2 * 2
    for track, x in zip(tracks, kept, strict=True):
        frequency, power = welch(
            x, 1.0 / track.dt, nperseg=rows, noverlap=rows // 2, axis=0, detrend="linear"
        )
        total, weight = total + len(x) * power, weight + len(x)
    level = np.log(total / weight + 1e-30)
    width = int(AROUND / (frequency[1] - frequency[0])) | 1
    return frequency, np.exp(level - median_filter(level, (width, 1), mode="nearest"))
