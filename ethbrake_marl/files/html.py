"""Tables for notebooks: everything in them is text, whatever it says."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

from ethbrake_marl.errors import plain_text


def html_table(head: Sequence[object], rows: Iterable[Sequence[object]], *, caption: str = "", note: str = "") -> str:
    """A table with a caption above and a note below it, each cell escaped and without control characters.

    Args:
        head: one heading per column.
        rows: each with one cell per heading; the first is a heading of its row.
        caption: what the table is, in one line.
        note: what must be known to read it, in a sentence or two.

    """
    lines = ["<table>"]
    lines += [f"<caption>{_text(caption)}</caption>"] if caption else []
    lines += ["<thead><tr>", *(f'<th scope="col">{_text(cell)}</th>' for cell in head), "</tr></thead>", "<tbody>"]
    for first, *rest in rows:
        lines += [f'<tr><th scope="row">{_text(first)}</th>', *(f"<td>{_text(cell)}</td>" for cell in rest), "</tr>"]
    lines += ["</tbody>", "</table>"]
    lines += [f"<p>{_text(note)}</p>"] if note else []
    return "\n".join(lines)


def _text(value: object) -> str:
    return escape(plain_text(str(value), keep="\u00a0"))
