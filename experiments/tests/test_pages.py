"""What stands beside stored results."""

import json
import sys

from experiments.pages import page_parser, publish


def test_results_name_the_command_without_their_own_places_and_the_commit(tmp_path, monkeypatch, capsys):
    arguments = ["--number", "3", "--name", "two words", "--commit=abc", "--out", str(tmp_path / "page")]
    monkeypatch.setattr(sys, "argv", ["study", *arguments])
    parser = page_parser("A study.", "page")
    parser.add_argument("--number", type=int)
    parser.add_argument("--name")

    def study(options):
        return {"number": options.number}

    publish(parser.parse_args(arguments), study, lambda results: [f"{results['number']} things"])
    results = json.loads((tmp_path / "page.json").read_text())
    assert results["number"] == 3 and results["seconds"] >= 0
    assert results["command"].endswith(" --number 3 --name 'two words'")
    assert results["machine"]["commit"] == "abc" and results["machine"]["versions"]["jax"]
    assert (tmp_path / "page.md").read_text() == "3 things\n"
