"""What a reproduction refuses."""

import json
from pathlib import Path
from typing import Any

import pytest

from ethbrake_marl.errors import AlreadyExists
from ethbrake_marl.extensions.reproduction.folder import Reproduction
from ethbrake_marl.extensions.reproduction.items import read_results
from ethbrake_marl.extensions.reproduction.learning_curves import LearningCurves
from ethbrake_marl.extensions.reproduction.making import make_items, open_folder
from ethbrake_marl.extensions.reproduction.pages import render_page
from tests.extensions.reproduction.test_reproduction import drawn, made, planted
from tests.fixtures.pictures import draw_nothing
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


@pytest.mark.parametrize(
    "svg",
    [
        "<script>alert(1)</script>",
        '<g onload="alert(1)"/>',
        '<g style="onload: alert(1)"/>',
        '<use href="#x"/>',
        '<use xmlns:l="http://www.w3.org/1999/xlink" l:href="https://example.org/x.svg#x"/>',
        '<path fill="url(https://example.org/x)"/>',
        '<path style="fill: URL(https://example.org/x)"/>',
        "<foreignObject/>",
        '<g xmlns="http://www.w3.org/1999/xhtml"/>',
        "<g>",
        "<g>" * 20_000 + "</g>" * 20_000,
    ],
    ids=lambda svg: svg[:40],
)
def test_figure__that_is_more_than_lines_is_not_shown(
    svg: str, empty_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        draw_nothing(patch)
        results = reproduced(drawn(), {})
    Path("out/gaps/a-figure.svg").write_text(f'<svg xmlns="http://www.w3.org/2000/svg">{svg}</svg>')
    with refused("out/gaps/a-figure.svg: the file is not an SVG figure of this package; draw the figure"):
        render_page(Path("out"), results)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ppo", "recipes 'ppo': 'ppo' must have the form RECIPE:SEEDS (number of seeds), for instance"),
        ("ppo:0", "recipes 'ppo:0': 'ppo:0' must have the form RECIPE:SEEDS"),
        ("ppo:2,ppo:3", "recipes 'ppo:2,ppo:3': two recipes have the same name"),
    ],
)
def test_recipes_of_learning_curves__are_refused(text: str, message: str) -> None:
    with refused(message):
        LearningCurves.parse(text)


def test_reproduction__is_written_to_a_folder_of_its_own(empty_folder: Path) -> None:
    Path("mine").mkdir()
    Path("link").symlink_to("mine")
    with refused("link: this is a symbolic link; give the path of a folder (--output)"):
        open_folder(Reproduction("quick", Path("link"), 24))
    Path("mine/thesis.txt").write_text("years of work")
    with refused("mine: the folder exists, but does not contain a reproduction; give another folder", AlreadyExists):
        open_folder(Reproduction("quick", Path("mine"), 24), force=True).check()
    assert Path("mine/thesis.txt").read_text() == "years of work"
