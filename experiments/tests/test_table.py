"""The page of a study: what stands beside stored results, and what a table shows of a record."""

import json
import math
import sys

import pytest

from experiments.flying.single_thread import share_out
from experiments.table import Page, Table, page_parser, publish, write_page


def test_results_name_the_command_without_their_own_places_and_the_commit(tmp_path, monkeypatch):
    arguments = ["--number", "3", "--name", "two words", "--commit=abc"]
    arguments += ["--out", str(tmp_path / "page")]
    monkeypatch.setattr(sys, "argv", ["study", *arguments])
    parser = page_parser("A study.", "page")
    parser.add_argument("--number", type=int)
    parser.add_argument("--name")

    def study(options):
        return {"number": options.number}

    def page(results):
        return Page(
            "Things", f"{results['number']} of them.", Table({"number": "number"}, [results])
        )

    publish(parser.parse_args(arguments), study, page)
    results = json.loads((tmp_path / "page.json").read_text())
    assert results["number"] == 3 and results["seconds"] >= 0
    assert results["command"].endswith(" --number 3 --name 'two words'")
    assert results["machine"]["commit"] == "abc" and results["machine"]["versions"]["jax"]
    written = (tmp_path / "page.md").read_text()
    assert written.startswith("# Things\n\n3 of them.\n\n| number |\n| --- |\n| 3 |\n\nMade with ")
    assert f"(abc) by `{results['command']}` on " in written


def test_words_of_a_page_stay_and_its_table_is_made_anew(tmp_path, capsys):
    path = tmp_path / "page.md"
    path.write_text("# Words\n\n<!-- table -->\n| old |\n<!-- end of table -->\n\nMore words.\n")
    number = {"number": "number"}
    made = Page("Things", "", [Table(number, [{"number": 1}])], Table(number, [{"number": 2}]))
    write_page(tmp_path / "page", lambda results: made, {"command": "make things"})
    table = "| number |\n| --- |\n| 2 |"
    assert path.read_text() == (
        f"# Words\n\n<!-- table -->\n{table}\n<!-- end of table -->\n\nMore words.\n"
    )
    assert "| 1 |" in capsys.readouterr().out  # the report has what the page has not


def test_cells_of_records():
    record = {
        "name": "one",
        "rates": {"crash": 0.25},
        "seeds": [1.0, 3.0],
        "nan": float("nan"),
        "done": True,
    }
    columns = {
        "name": "name",
        "crash": "rates.crash:.3f",
        "seeds": "seeds:.1f",
        "nan": "nan:.1f",
        "none": "rates.none:.1f",
        "done": "done",
        "twice": lambda row: f"{2 * row['rates']['crash']:.1f}",
    }
    row = Table(columns, [record]).lines()[-1]
    assert row == "| one | 0.250 | 2.0 (1.4) | – | – | yes | 0.5 |"


def test_a_job_that_fails_costs_no_other(capsys):
    done = []
    with pytest.raises(RuntimeError, match="1 of 3"):
        for root in share_out(math.sqrt, [(4.0,), (-1.0,), (9.0,)], 2):
            done.append(root)
    assert sorted(done) == [2.0, 3.0] and "(-1.0,): ValueError" in capsys.readouterr().err
