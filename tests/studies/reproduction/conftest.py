from __future__ import annotations

from pathlib import Path

import pytest

from ethbrake_marl.studies.reproduction.item import Drawn, Item, Made, Parameter, Settings, Table, Verdict

HOSTILE = "<script>alert('x')</script>\"|*_\u202e"


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    """Quick, and few worlds."""
    return Settings("quick", tmp_path / "out", 24, machine="a machine")


def made(text: str = "told", figures: tuple[Drawn, ...] = ()) -> Made:
    """What an item may give, with one text everywhere."""
    return Made(
        (Verdict(text, "agrees", text),),
        (Parameter(text, text, text),),
        (Table(text, (text, text), ((text, text),), text),),
        figures,
        {"data": "a,b\n"},
        (text,),
    )


def planted(name: str, make) -> Item:
    """An item of a known name that does something else."""
    return Item(name, ("label",), "A title", "What it is.", make, 3)
