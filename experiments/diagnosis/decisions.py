"""What a decision of the diagnosis was made of, as plain arrays: to try other rules on development
cases without fitting anything anew.
"""

import pickle
from pathlib import Path

import numpy as np


def keep(report, line: dict, folder: Path) -> None:
    """Write the visited sets of a case's report, and what its channels and its check say."""
    evidence = report.plots["evidence"]
    selection = report.plots["selection"]
    search = getattr(selection, "search", None)
    if search is None:
        return
    from openjax.gap.selection import difference, possible

    sets = list(search.visited.values())
    pairs = np.array([[difference(a.judged, b.judged) for b in sets] for a in sets], np.float32)
    visited = [
        {
            "effects": h.effects,
            "log_odds": h.log_odds,
            "cost": h.fit.cost,
            "nats": h.judged.nats.astype(np.float32),
            "squares": h.judged.squares.astype(np.float32),
            "taken": h.judged.taken.mean(0).astype(np.float32),
            "possible": possible(h.fit),
            "parameters": h.fit.parameters(),
        }
        for h in sets
    ]
    kept = {
        "line": line,
        "visited": visited,
        "pairs": pairs,
        "nuisances": [
            n for n, s in zip(evidence.replay.nuisance_names, evidence.replay.shared, strict=True) if s
        ],
        "exposure": evidence.motion.exposure,
        "singles": {e: f.score - evidence.motion.nothing.score for e, f in evidence.motion.singles.items()},
        "channels": {c.path: (c.acting(), c.named()) for c in evidence.channels},
        "measures": report.residual,
        "before": getattr(getattr(evidence, "baseline", None), "measures", None),
        "seconds": report.seconds,
    }  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{line['set']}_{line['case']}.pkl").write_bytes(pickle.dumps(kept))
