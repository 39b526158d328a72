"""The page of the effects has them all, and pages of results have one form that reads
at a glance.
"""

import ast
import importlib.util
import json
import pkgutil
import re
from importlib.util import find_spec
from pathlib import Path

import pytest

import openjax
from openjax.__main__ import COMMANDS
from openjax.vehicle.effects import EFFECTS

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
RESULTS = ROOT / "experiments" / "results"
# folders that building the site leaves
MADE = ("_build", "generated", "jupyter_execute", "measured")
PAGES = [path for path in sorted(DOCS.rglob("*.md")) if not set(MADE) & set(path.parts)]
PAGES += [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
MOST = {"words": 600, "rows": 10, "line": 400, "sentences": 3, "pictures": 1}
"""Of a page of results: words of prose, rows of its one table, characters of a line,
sentences of the answer, pictures.
"""
COMMIT = re.compile(r"\b(?=[a-f]*\d)(?=\d*[a-f])[0-9a-f]{7,40}\b")


def prose_of(text: str) -> list[str]:
    """Lines that are neither of a table, nor of a picture, nor of code."""
    text = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    return [line for line in text.splitlines() if not line.lstrip().startswith(("|", "!", "<"))]


@pytest.mark.parametrize("path", sorted(RESULTS.rglob("*.md")), ids=lambda path: path.stem)
def test_results_have_one_form(path):
    """A question, an answer of at most three sentences, one short table, one picture,
    how sure.

    Seeds, cores, commits and further tables belong into the JSON beside the page.
    """
    text = path.read_text(encoding="utf-8")
    title, question, answer = text.split("\n\n")[:3]
    assert title.startswith("# ") and question.endswith("?"), "title, then the question"
    assert "\n## How sure\n" in text
    sentences = re.findall(r"[.!?](?=\s|$)", answer)
    assert len(sentences) <= MOST["sentences"], answer
    tables = re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)
    assert len(tables) == 1, "one table; `--report` prints the others"
    assert tables[0].count("\n") - 2 <= MOST["rows"]
    assert len(re.findall(r"^!\[", text, re.MULTILINE)) <= MOST["pictures"]
    words = re.findall(r"\S*[^\W\d_]\S*", "\n".join(prose_of(text)))
    assert len(words) <= MOST["words"], len(words)


@pytest.mark.parametrize(
    "path",
    [*PAGES, *sorted(RESULTS.rglob("*.md"))],
    ids=lambda path: f"{path.parent.name}/{path.stem}",
)
def test_lines_of_prose_are_short(path):
    for line in prose_of(path.read_text(encoding="utf-8")):
        assert len(line) <= MOST["line"], line


def texts_of(stored, record=None):
    """Each text of what a JSON file holds, with the record that it stands in."""
    if isinstance(stored, str):
        yield stored, record
    elif isinstance(stored, dict):
        for value in stored.values():
            yield from texts_of(value, stored)
    elif isinstance(stored, list):
        for value in stored:
            yield from texts_of(value, record)


@pytest.mark.parametrize(
    "path",
    [ROOT / "experiments" / "README.md", *sorted(RESULTS.rglob("*.md")), *RESULTS.rglob("*.json")],
    ids=lambda path: path.name,
)
def test_programs_that_results_name_are_there(path):
    """Or a commit that has them is named beside them: in the same paragraph, or as the
    record's `program`, in the words of `git show`.
    """
    text = path.read_text(encoding="utf-8")
    named = texts_of(json.loads(text)) if path.suffix == ".json" else texts_of(text.split("\n\n"))
    for line, record in named:
        assert set(re.findall(r"(?:^|`)openjax ([a-z_]+)(?= -)", line)) <= set(COMMANDS), line
        for name in re.findall(r"python -m ((?:openjax|experiments|tests)\b[\w.]*)", line):
            if name.removeprefix("openjax.") in COMMANDS:
                continue
            place = (record or {}).get("program", "").partition(":")[2]
            moved = place.startswith(name.replace(".", "/"))
            assert moved or COMMIT.search(line) or "NAME" in name or find_spec(name), name


def program_of_docs(name: str):
    """A program beside the pages, which are no package."""
    spec = importlib.util.spec_from_file_location(name, DOCS / f"{name}.py")
    program = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(program)
    return program


def test_notebooks_are_made_from_the_tutorials():
    """Colab opens them: the same text and code, after a cell that installs."""
    made = program_of_docs("make_notebooks").made()
    assert set(made) == set((DOCS / "notebooks").glob("*.ipynb")) and len(made) == 2
    for path, text in made.items():
        assert path.read_text(encoding="utf-8") == text, "run python docs/make_notebooks.py"
        book = json.loads(text)
        cells = ["".join(cell["source"]) for cell in book["cells"]]
        page = (DOCS / "tutorials" / f"{path.stem}.md").read_text(encoding="utf-8")
        assert "%pip install" in cells[0] and "<!--" not in "".join(cells)
        code = [cell for cell in book["cells"] if cell["cell_type"] == "code"]
        assert len(code) == 1 + page.count("```{code-cell}")
        for cell in code[1:]:
            ast.parse("".join(cell["source"]))
            assert "".join(cell["source"]) in page


def test_the_release_reads_the_version_where_it_is_written():
    workflow = (ROOT / ".github" / "workflows" / "release.yml").read_text(encoding="utf-8")
    (path,) = re.findall(r"(src/openjax/\S+\.py)\)", workflow)
    (version,) = re.findall(r'^__version__ = "(.*)"$', (ROOT / path).read_text("utf-8"), re.M)
    assert version == openjax.__version__


def test_page_of_the_effects_has_them_all():
    """The site's build makes it."""
    page = program_of_docs("make_effects").page()
    for name, effect in EFFECTS.items():
        assert effect.formula, f"{name}: no formula"
        assert f"## {name}\n" in page and effect.formula in page
        assert (DOCS / "pictures" / "effects" / f"{name}.png").exists()


def test_names_of_the_api_page_are_there():
    """A program that is renamed keeps its place on the page; the site itself takes
    minutes.
    """
    text = (DOCS / "api.md").read_text(encoding="utf-8")
    names = re.findall(r"auto(?:class|function|exception):: (\S+)", text)
    # the package's own names first: it has modules of the same names
    places = [re.sub(r"^(openjax)\.(\w+)$", r"\1:\2", name) for name in names]
    missing = [place for place in places if not callable(pkgutil.resolve_name(place))]
    assert len(names) > 50 and not missing
    members = re.findall(r"autoclass:: (\S+)\n +:members: (\S.*)", text)
    gone = [
        f"{name}.{member}"
        for name, listed in members
        for member in listed.split(", ")
        if not hasattr(pkgutil.resolve_name(name), member)
    ]
    assert members and not gone


def test_what_pages_and_their_programs_import_is_there():
    """A function that moves is looked for in tutorials, too, which run only where the
    site is built.
    """
    # below a cell's first line stand its options, which begin with a colon
    code = re.compile(r"^```(?:python|\{code-cell\}[^\n]*)\n(?::.*\n)*(.*?)^```", re.M | re.S)
    texts = [
        (page.name, text)
        for page in PAGES
        for text in code.findall(page.read_text(encoding="utf-8"))
    ]
    texts += [(path.name, path.read_text("utf-8")) for path in DOCS.glob("*.py")]
    imports = [
        (name, node.module, alias.name)
        for name, text in texts
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.ImportFrom) and node.module.startswith("openjax")
        for alias in node.names
    ]
    assert len(imports) > 10
    for page, module, name in imports:
        try:
            pkgutil.resolve_name(f"{module}.{name}")
        except (ImportError, AttributeError) as error:
            pytest.fail(f"{page} imports {name} from {module}: {error}")
