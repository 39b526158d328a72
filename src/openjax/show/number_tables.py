"""Tables on the terminal."""

from rich import box
from rich.table import Table


def numbers_table(title: str, first: str, *heads: str, caption: str | None = None) -> Table:
    """An empty table; the column `first` holds names, the others numbers."""
    looks = {
        "title_justify": "left",
        "caption_justify": "left",
        "box": box.SIMPLE,
        "pad_edge": False,
    }
    table = Table(title=title, caption=caption, padding=0, **looks)
    table.add_column(first)
    for head in heads:
        table.add_column(head, justify="right")
    return table
