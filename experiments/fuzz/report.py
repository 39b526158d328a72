"""The page of the results."""

from collections import Counter

from experiments.fuzz.cases import MEGABYTES, SECONDS
from experiments.pages import table, where


def page(parts: dict) -> str:
    """The results as Markdown; parts are `note`, `cases`, `damages`, `kills`, any of which may be missing."""
    lines = ["# Hostile input, damaged checkpoints, kills"]
    if "note" in parts:  # written by hand, of what was measured elsewhere
        lines += ["", parts["note"]]
    for name, section in (("cases", _cases), ("damages", _damages), ("kills", _kills)):
        if name in parts:
            part = parts[name]
            lines += [
                "",
                *section(part),
                "",
                f"{where(part)} {part['machine']['cpu_cores']} cores, {part['seconds']} s.",
            ]
    return "\n".join(lines) + "\n"


def _cases(part):
    rows, total = [], Counter()
    for kind, counts in part["counts"].items():
        total.update(counts)
        rows.append(_row(kind, counts))
    lines = [
        "## Hostile input",
        "",
        "Inputs changed at random, seeds fixed. Failed: a traceback, a value accepted that isn't finite or lies outside its "
        f"range, a file left behind, more than {SECONDS:.0f} s or {MEGABYTES:.0f} MB.",
        "",
        *table(["input", "tried", "refused in one line", "accepted", "failed"], [*rows, _row("all", total)]),
    ]
    for failure in part["failures"][:20]:
        text = failure["text"].splitlines()[-1][:300]
        lines += ["", f"Failed: {failure['kind']}, seed {failure['seed']}: `{text}`"]
    return lines


def _row(kind, counts):
    cells = [sum(counts.values()), *(counts.get(name, 0) for name in ("refused", "accepted", "failed"))]
    return [kind, *(f"{cell:,}" for cell in cells)]


MEANING = {
    "same": "the newest restored, bit for bit: the older one was hit, or nothing of the state",
    "before": "found, and the checkpoint before it restored, bit for bit",
    "refused": "both were hit, or the only undamaged one was gone, and one line says so",
}


def _damages(part):
    rows = [
        [outcome, f"{number:,}", MEANING.get(outcome, "**wrong**")]
        for outcome, number in part["outcomes"].items()
    ]
    return [
        "## Damaged checkpoints",
        "",
        f"{sum(part['outcomes'].values())} damages to a run's two checkpoints: bits, ends, pieces, whole files.",
        "",
        *table(["outcome", "times", "meaning"], sorted(rows)),
    ]


def _kills(part):
    tries = part["tries"]
    good = sum(kill["outcome"] == "the same bits" for kill in tries)
    late = sum(kill["went_on_by"] == "had ended" for kill in tries)
    rows = [
        [str(kill["seconds"]), kill["moment"], str(kill["checkpoints"]), kill["went_on_by"], kill["outcome"]]
        for kill in tries
    ]
    return [
        "## Kills",
        "",
        f"A run of {part['whole_run']} s was killed (SIGKILL) at {len(tries)} instants, then gone on with. "
        f"{good} of {len(tries)} ended with the last training state and the policy of the run that nobody killed, bit for bit."
        + (f" {late} had ended by then: runs beside others' took less than the one alone." if late else ""),
        "",
        *table(["killed after, s", "while", "checkpoints then", "went on by", "result"], rows),
    ]
