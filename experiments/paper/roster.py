"""Who is compared in the paper's tables, and with which of the shipped weights."""

from openjax.baselines import METHODS as HEURISTICS
from openjax.store.policy_files import shipped_policies

METHODS = {
    "Angelani": "angelani",
    "Janosov": "janosov",
    "APF": "apf",
    "DACOOP": "dacoop",
    "MAPPO": "mappo",
    "OPEN": "open",
}
"""The paper's six methods, and the name or the beginning of the names of their policies."""
ABLATIONS = {"MAPPO + predictor": "predictor", "MAPPO + generator": "generator"}
"""The paper's other variants: MAPPO + EPN, MAPPO + AEG."""
SEEDS = 3
HUES = (
    *("tab:orange", "tab:olive", "tab:brown", "tab:purple"),
    *("0.3", "tab:red", "tab:blue", "tab:green"),
)
COLORS = dict(zip((*METHODS, *ABLATIONS), HUES, strict=True))


def seeds_of(label: str) -> list[tuple[str, int]]:
    """(policy, evaluation seed) for each of a method's seeds: those of its training, or of its
    start attitudes where there is no training.
    """
    beginning = (METHODS | ABLATIONS)[label]
    if beginning in HEURISTICS:
        return [(beginning, seed) for seed in range(SEEDS)]
    return [(name, 0) for name in shipped_policies() if name.split("_seed_")[0] == beginning]


def flights_of(results: dict, label: str, condition: str = "clamp") -> list[dict]:
    """What tables.py stored of a method, one per seed."""
    return [f for f in results["flights"] if f["method"] == label and f["condition"] == condition]
