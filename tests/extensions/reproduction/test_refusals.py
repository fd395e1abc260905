"""What a reproduction refuses."""

import json
from pathlib import Path
from typing import Any

import pytest

from ethbrake_marl.errors import AlreadyExists
from ethbrake_marl.extensions.reproduction.folder import Reproduction
from ethbrake_marl.extensions.reproduction.items import read_results
from ethbrake_marl.extensions.reproduction.making import make_items, open_folder
from tests.extensions.reproduction.test_reproduction import made, planted
from tests.refused import refused


def reproduced(figures: Any, changes: dict[str, Any]) -> dict[str, Any]:
    """A reproduction of one planted item, whose result on the disk was changed; its results."""
    results, _ = make_items(
        Reproduction("quick", Path("out"), 24, machine="a machine"),
        [planted("gaps", lambda settings: made(figures=figures))],
    )
    file = Path("out/gaps/result.json")
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))
    return results


VERDICT = {"what": "all", "outcome": "agrees", "because": "of 25 comparisons 25 agree"}


@pytest.mark.parametrize(
    ("where", "changes"),
    [
        ("tables", {"tables": "x"}),
        ("tables: 0: rows: 0: 0: 0", {"tables": [{"title": "t", "head": ["h"], "rows": [[[1]]], "note": ""}]}),
        ("tables: rows", {"tables": [{"title": "t", "head": ["h"], "rows": [[["a"]], []], "note": ""}]}),
        ("verdict: what", {"verdict": {}}),
        ("verdict", {"verdict": VERDICT}),
        ("verdict", {"comparisons": []}),
        ("figures: 0", {"figures": [1]}),
        ("name", {"name": "../elsewhere"}),
        ("name", {"name": "random-table"}),
        ("data", {"data": ["../../x.csv"]}),
        ("comparisons: 0: outcome", {"comparisons": [{"what": "w", "outcome": "<b>great</b>", "because": ""}]}),
        ("notes: 1", {"notes": ["a", None]}),
        ("figures: 0: stem", {"figures": [{"stem": "../../etc/passwd", "title": "t", "text": "t"}]}),
        ("figures: 0: stem", {"figures": [{"stem": "<svg>", "title": "t", "text": "t"}]}),
        ("figures: 0: stem", {"figures": [{"stem": "x" * 65, "title": "t", "text": "t"}]}),
    ],
    ids=str,
)
def test_result__that_was_changed_is_made_again(where: str, changes: dict[str, Any], empty_folder: Path) -> None:
    reproduced({}, changes)
    with refused(
        f"out/gaps/result.json: the key {where} is missing or its value is wrong; reproduce the item again (--force)"
    ):
        read_results(Path("out"))
    with refused(
        f"out/gaps/result.json: the key {where} is missing or its value is wrong; reproduce the item again (--force)"
    ):
        make_items(
            Reproduction("quick", Path("out"), 24, machine="a machine"),
            [planted("harm-delays", lambda settings: made())],
        )


def test_reproduction__is_written_to_a_folder_of_its_own(empty_folder: Path) -> None:
    Path("mine").mkdir()
    Path("link").symlink_to("mine")
    with refused("link: this is a symbolic link; give the path of a folder (--output)"):
        open_folder(Reproduction("quick", Path("link"), 24))
    Path("mine/thesis.txt").write_text("years of work")
    with refused("mine: the folder exists, but does not contain a reproduction; give another folder", AlreadyExists):
        open_folder(Reproduction("quick", Path("mine"), 24), force=True).check()
    assert Path("mine/thesis.txt").read_text() == "years of work"
