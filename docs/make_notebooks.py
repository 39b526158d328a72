"""The tutorials as notebooks, for Colab or Jupyter: `python docs/make_notebooks.py`.

A tutorial is a MyST page whose cells the site runs. Its notebook holds the same text and code, after
a first cell that installs openjax.
"""

import json
import re
import tomllib
from pathlib import Path

DOCS = Path(__file__).parent
NOTEBOOKS = DOCS / "notebooks"
CELL = re.compile(r"^```\{code-cell\}[^\n]*\n((?::[^\n]*\n)*)(.*?)^```\n", re.M | re.S)
INSTALL = """\
try:
    import openjax
except ModuleNotFoundError:
    %pip install -q "openjax @ git+{address}"
"""


def address() -> str:
    """The repository's, as pyproject.toml has it."""
    with (DOCS.parent / "pyproject.toml").open("rb") as file:
        return tomllib.load(file)["project"]["urls"]["Repository"]


def text_cell(name: str, text: str) -> dict:
    """Markdown without the page's comments, its links leading to the repository."""
    pages = f"{address()}/blob/main/docs"
    text = re.sub(r"<!-- (\w+) -->\n.*?<!-- end of \1 -->\n", "", text, flags=re.S)
    text = re.sub(r"\]\(\.\./", f"]({pages}/", text)
    return {"cell_type": "markdown", "id": name, "metadata": {}, "source": lines(text.strip())}


def code_cell(name: str, code: str, options: str = "") -> dict:
    """Code that hasn't run, with the tags of its options."""
    tags = re.findall(r"^:tags: \[(.*)\]$", options, re.M)
    return {
        "cell_type": "code",
        "execution_count": None,
        "id": name,
        "metadata": {"tags": [tag.strip() for tag in tags[0].split(",")]} if tags else {},
        "outputs": [],
        "source": lines(code.strip()),
    }


def lines(text: str) -> list[str]:
    """As a notebook's file keeps them."""
    return text.splitlines(keepends=True)


def notebook(page: str) -> dict:
    """The notebook of a tutorial's text."""
    body = page.partition("---\n")[2].partition("---\n")[2]
    cells = [code_cell("install", INSTALL.format(address=address()))]
    end = 0
    for number, found in enumerate(CELL.finditer(body)):
        if text := body[end : found.start()].strip():
            cells.append(text_cell(f"text-{number}", text))
        cells.append(code_cell(f"code-{number}", found[2], found[1]))
        end = found.end()
    cells.append(text_cell("text-end", body[end:]))
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {
        "cells": cells,
        "metadata": {"kernelspec": kernel, "language_info": {"name": "python"}},
        "nbformat": 4,
        "nbformat_minor": 5,
    }


def made() -> dict[Path, str]:
    """The text of each notebook's file."""
    pages = sorted((DOCS / "tutorials").glob("*.md"))
    notebooks = {page.stem: notebook(page.read_text(encoding="utf-8")) for page in pages}
    return {
        NOTEBOOKS / f"{name}.ipynb": json.dumps(book, indent=1, ensure_ascii=False) + "\n"
        for name, book in notebooks.items()
    }


def main() -> None:
    """Write them."""
    NOTEBOOKS.mkdir(exist_ok=True)
    for path, text in made().items():
        path.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
