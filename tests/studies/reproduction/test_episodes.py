"""Episodes on the page of a reproduction: driven again, replayed by their passports, read with suspicion."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from pathlib import Path

import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.episodes import Given, parse_passport, replay
from ethbrake_marl.files.yaml import parse_overrides
from ethbrake_marl.studies.reproduction.folder import EPISODES, choose_items, kept_player, reproduce
from ethbrake_marl.studies.reproduction.item import Settings
from tests.pages.hostile import Page

from .conftest import made, planted

EPISODE = {"pieces": base64.b64encode(bytes(80)).decode(), "end": 1.0, "impacts": [],
           "stepped": [], "driven": [1], "rest": True, "obstacle": None, "passport": "EB1"}  # fmt: skip
WORLD = {"number": 1, "title": "One", "kind": "k", "why": "", "conditions": "c", "episodes": [EPISODE]}
CONTENT = {"vehicles": 3, "agents": ["PPO"], "shown": [0], "worlds": [WORLD]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The trajectories, made again."""
    path = tmp_path_factory.mktemp("trajectories") / "out"
    reproduce(choose_items(["trajectories"]), Settings("quick", path, 10))
    return path


@pytest.mark.slow
def test_trajectories__are_watched_side_by_side(folder: Path) -> None:
    page = Page((folder / "index.html").read_text("utf-8"))
    assert page.open == [] and "Passports" in page.text
    content = json.loads((folder / "trajectories" / EPISODES).read_text("utf-8"))
    assert [content["agents"][k] for k in content["shown"]] == ["PPO", "SAC"]
    titles = [world["title"] for world in content["worlds"]]
    assert titles[0] == "Scenario 1, as stated" and len(set(titles)) == 4


@pytest.mark.slow
@pytest.mark.parametrize("world", [0, 3])
def test_trajectories__passports_play_them_again(folder: Path, world: int) -> None:
    content = json.loads((folder / "trajectories" / EPISODES).read_text("utf-8"))
    played = content["worlds"][world]
    settings = tuple(parse_overrides([played["why"].partition("--set ")[2]])) if played["why"] else ()
    again = replay(parse_passport(played["episodes"][0]["passport"]), Given(settings=settings))
    assert again.same and again.differences == ()


def test_page__of_a_result_without_episodes_has_no_player(settings: Settings) -> None:
    reproduce([planted("gaps", lambda s: made())], settings)
    assert "data-episodes" not in (settings.folder / "index.html").read_text("utf-8")


def test_episodes__that_somebody_wrote_are_text(tmp_path: Path) -> None:
    hostile = "</script><script>alert(1)</script>\u202e"
    one = WORLD | {"title": hostile, "episodes": [EPISODE | {"passport": hostile}]}
    (tmp_path / EPISODES).write_text(json.dumps(CONTENT | {"agents": [hostile], "worlds": [one]}))
    part = kept_player(tmp_path)
    assert (
        part is not None
        and "alert(1)</script>" not in part.html
        and "\u202e"
        not in json.loads(part.html.split('type="application/json"')[1].partition(">")[2].partition("</script>")[0])[
            "agents"
        ][0]
    )


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"vehicles": 10**6}, "vehicles"),
        ({"shown": [1]}, "worlds"),
        ({"more": 1}, "more"),
        ({"worlds": [WORLD | {"episodes": []}]}, "worlds"),
        ({"worlds": [WORLD | {"episodes": [EPISODE | {"pieces": "AAAA"}]}]}, "worlds"),
        ({"worlds": [WORLD | {"episodes": [EPISODE | {"pieces": "<b>"}]}]}, "worlds"),
        ({"worlds": [WORLD | {"episodes": [EPISODE | {"end": "1"}]}]}, "end"),
        ({"worlds": [WORLD | {"episodes": [EPISODE | {"driven": [3]}]}]}, "worlds"),
    ],
)
def test_episodes__that_are_damaged_are_refused(tmp_path: Path, change: dict, where: str) -> None:
    (tmp_path / EPISODES).write_text(json.dumps(CONTENT))
    assert kept_player(tmp_path) is not None
    (tmp_path / EPISODES).write_text(json.dumps(CONTENT | change))
    with pytest.raises(InvalidInput, match=f"{where}.*make it again"):
        kept_player(tmp_path)


def test_reproduce__an_item_without_episodes_leaves_none_behind(settings: Settings) -> None:
    items = [planted("gaps", lambda s: replace(made(), episodes=CONTENT))]
    reproduce(items, settings)
    assert (settings.folder / "gaps" / EPISODES).is_file()
    reproduce([planted("gaps", lambda s: made())], settings, force=True)
    assert not (settings.folder / "gaps" / EPISODES).exists()
