"""Figures, and the files that they are written to. The modules load matplotlib; this one does not."""

from __future__ import annotations

from pathlib import Path

from ethbrake_marl.errors import InvalidInput

PICTURE_ENDINGS = (".png", ".svg", ".pdf")


def picture_ending(path: str | Path) -> str:
    """The ending that says how a picture is written; raises ``InvalidInput`` for any but those of PICTURE_ENDINGS."""
    ending = Path(path).suffix.lower()
    if ending not in PICTURE_ENDINGS:
        raise InvalidInput(f"{path}: pictures are written as PNG, SVG or PDF; end the name in .png, .svg or .pdf")
    return ending
