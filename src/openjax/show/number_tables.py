"""Tables on the terminal."""

from collections.abc import Sequence

from rich import box
from rich.table import Table


def numbers_table(title: str, heads: Sequence[str], caption: str | None = None) -> Table:
    """An empty table; the first column holds names, the others numbers."""
    looks = {
        "title_justify": "left",
        "caption_justify": "left",
        "box": box.SIMPLE,
        "pad_edge": False,
    }
    table = Table(title=title, caption=caption, padding=0, **looks)
    first, *others = heads
    table.add_column(first)
    for head in others:
        table.add_column(head, justify="right")
    return table
