"""The search for a set of effects, its fits replaced by a table of scores."""

from types import SimpleNamespace

import pytest

from openjax.gap import selection

SCORES = {"": 0.0, "a": 100.0, "b": 50.0, "a b": 60.0, "a c": 110.0, "b c": 120.0}


def fit_of(*effects):
    return SimpleNamespace(effects=tuple(sorted(effects)), score=SCORES[" ".join(sorted(effects))])


@pytest.fixture
def search(monkeypatch):
    """A search in which `a` makes way for `b` and `c`, `b` for `a` and `c`, and `c` is pruned each time."""
    asked = []

    def mended(replay, fit, singles, newest):
        asked.append(fit)
        assert len(asked) < 20, "the search goes round and round"
        return fit_of(newest, "c")

    singles = {e: None for e in "ab"}
    for name, stub in {
        "_openings": lambda replay, nothing, left: [fit_of("a")],
        "_ranked": lambda table, singles, now: ["b" if now.effects == ("a",) else "a"],
        "_joined": lambda replay, fit, singles, effect: fit_of(effect, *fit.effects),
        "_mended": mended,
        "_stays": lambda table, whole, added: True,
        "build": lambda replay, fit, singles: fit,
        "with_effects": lambda fit: fit,
        "judge": lambda table, fit: fit,
        "_pruned": lambda replay, fit, table, now, singles: (fit_of(*set(fit.effects) - {"c"}),) * 3,
    }.items():
        monkeypatch.setattr(selection, name, stub)
    nothing = fit_of()
    return lambda: selection._widened(None, nothing, nothing, nothing, singles, selection._Trail())[0]


def test_a_search_does_not_come_back_to_what_it_left(search):
    assert search().effects == ("b",)
