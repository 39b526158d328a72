"""Every figure that README and pages share is what one committed result says."""

import re

import pytest

from experiments import figures
from experiments.figures import BLOCKS, PAGES, ROOT, rendered

README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES)
def test_a_page_shows_what_is_stored(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    assert rendered(text) == text, "run python -m experiments.figures"
    assert set(re.findall(r"<!-- end of (\w+) -->", text)) & set(BLOCKS), "no block: leave it out"


def test_no_other_page_has_a_block():
    """It would keep the figures of the day on which it was written."""
    pages = [
        *ROOT.glob("*.md"),
        *(ROOT / "docs").rglob("*.md"),
        *(ROOT / "experiments").rglob("*.md"),
    ]
    blocks = re.compile(rf"^<!-- ({'|'.join(BLOCKS)}) -->", re.MULTILINE)
    found = {
        path.relative_to(ROOT).as_posix()
        for path in pages
        if not {"_build", "generated", "measured", "jupyter_execute"} & set(path.parts)
        if blocks.search(path.read_text(encoding="utf-8"))
    }
    assert found == set(PAGES)


def test_a_changed_result_changes_every_page(monkeypatch):
    """A figure that somebody typed between the marks wouldn't."""
    stored = figures.read

    def read(name):
        found = stored(name)
        for row in found.get("rows", ()) if name == "judged" else ():
            row["capture_rate"] = {place: 0.123 for place in row["capture_rate"]}
        return found

    monkeypatch.setattr(figures, "read", read)
    for page in ("README.md", "docs/questions.md", "docs/model_cards.md"):
        assert "0.12" in rendered((ROOT / page).read_text(encoding="utf-8")), page


def test_results_of_the_readme_are_todays():
    """Older weights and commits stand on pages of their own, if anywhere."""
    table = README.partition("<!-- results -->")[2].partition("<!-- end of results -->")[0]
    assert table.count("\n| ") >= 8
    assert not re.search(r"\b(?=[a-f]*\d)(?=\d*[a-f])[0-9a-f]{7,40}\b", README)


@pytest.mark.parametrize("page", ["README.md", "docs/start.md"])
def test_the_clone_address_stands_once(page):
    text = (ROOT / page).read_text(encoding="utf-8")
    assert text.count("git clone ") == 1
