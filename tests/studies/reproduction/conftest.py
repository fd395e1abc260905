from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from ethbrake_marl.files.sheet import Sheet
from ethbrake_marl.studies.reproduction import Drawn, Item, Made, Reproduction, Verdict, stated

HOSTILE = "<script>alert('x')</script>\"|*_\u202e"


@pytest.fixture
def settings(tmp_path: Path) -> Reproduction:
    """Quick, and few worlds."""
    return Reproduction("quick", tmp_path / "out", 24, machine="a machine")


def made(text: str = "told", figures: Mapping[Drawn, Figure] | None = None) -> Made:
    """What an item may give, with one text everywhere."""
    return Made(
        (Verdict(text, "agrees", text),),
        (stated(text, text, text),),
        (Sheet(text, (text, text), ((text, text),), text),),
        figures or {},
        {"data": "a,b\n"},
        (text,),
    )


def planted(name: str, make) -> Item:
    """An item of a known name that does something else."""
    return Item(name, ("label",), "A title", "What it is.", make, 3)
