"""Where causes are lost that the diagnosis misses.

    python -m experiments.diagnosis.lost --set DIR --lines cases.jsonl

`cases.jsonl` is what `experiments.diagnosis.development` writes of the cases in DIR. Of
each case with one cause whose first name isn't right it says, as JSON, at which step
the cause is lost, and by how many nats the best set with it scores above the one that
was chosen.
"""

import argparse
import json
from collections import Counter
from pathlib import Path

from experiments.flying.single_thread import use_single_thread

STEPS = {
    "channel": "poses, radio or rate loop tell it, not the motion",
    "exposure": "at its usual size it would not show in these flights",
    "likelihood": "no set with it predicts better by what counts as telling two apart",
    "bounds": "all better sets with it have parameters that can't be",
    "size": "all better sets with it have an effect too small to change a simulator for",
    "choice": "a better set with it may be named, and isn't chosen",
    "share": "it is chosen, and takes too little of the gap to stand first",
}


def where_lost(evidence, names: frozenset[str]) -> tuple[str, float | None]:
    """The step of `STEPS` at which the `names` that would be right are lost, and nats."""
    from openjax.gap.criteria import DETECTABLE
    from openjax.gap.selection import select

    physics = names & set(evidence.library.physics)
    if not physics:
        return "channel", None
    if max(evidence.motion.exposure[e] for e in physics) < DETECTABLE:
        return "exposure", None
    selection = select(evidence)
    if physics & set(selection.hypothesis.effects):
        return "share", None
    gains = gains_over(selection, physics)
    better = [h for h, gain in gains.items() if gain >= DETECTABLE]
    best = max(gains.values(), default=None)
    return refused_by(evidence, better), best


def gains_over(selection, physics: frozenset[str]) -> dict:
    """{hypothesis with one of the effects: nats by which it scores above the chosen
    one}.
    """
    from openjax.gap.selection import LARGEST

    search = selection.search
    chosen = search.hypotheses[frozenset(selection.hypothesis.effects)]
    for effect in physics & set(search.singles):
        search.of_set(search.torque_effects | {effect}, search.base.fit)
        if len(chosen.effects) < LARGEST:
            search.of_set({*chosen.effects, effect}, chosen.fit)
    with_it = [h for h in search.hypotheses.values() if physics & set(h.effects)]
    return {h: h.score - chosen.score for h in with_it}


def refused_by(evidence, better: list) -> str:
    """What keeps hypotheses that are better from being chosen."""
    from openjax.gap.criteria import possible, practical

    if not better:
        return "likelihood"
    allowed = [h for h in better if possible(h.fit)]
    if not allowed:
        return "bounds"
    large = any(practical(h.fit) for h in allowed)
    return "choice" if large else "size"


def main() -> None:
    """Run the module."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--set", type=Path, required=True)
    parser.add_argument("--lines", type=Path, required=True)
    options = parser.parse_args()
    use_single_thread()
    from openjax.flights.case import load_case
    from openjax.gap.evidence import gather, with_identification
    from openjax.gap.model.library import library

    steps = Counter()
    for line in map(json.loads, options.lines.read_text().splitlines()):
        if line["category"] != "single" or line["right"]:
            continue
        evidence = gather(load_case(options.set / line["case"]), library())
        names = frozenset(line["right_names"])
        step, nats = where_lost(with_identification(evidence), names)
        steps[step] += 1
        said = {"case": line["case"], "truth": line["truth"], "words": line["words"]}
        print(json.dumps(said | {"lost": step, "nats": nats}), flush=True)
    for step, count in steps.most_common():
        print(f"{count} {step}: {STEPS[step]}")


if __name__ == "__main__":
    main()
