"""Episodes on the page of a reproduction: two policies side by side, replayed by their passports."""

from __future__ import annotations

import json

import pytest

from ethbrake_marl.evaluation.episodes import Passport
from ethbrake_marl.files.yaml import Override
from ethbrake_marl.studies.reproduction import Reproduction
from tests.pages.hostile import Page

from .conftest import made, planted


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> str:
    """That of the trajectories, made again."""
    path = tmp_path_factory.mktemp("trajectories") / "out"
    Reproduction("quick", path, 10).make(Reproduction.choose(["trajectories"]))
    return (path / "index.html").read_text("utf-8")


def played(page: str) -> dict:
    """What the page gives its player."""
    text = page.split('type="application/json"')[1].partition(">")[2].partition("</script>")[0]
    return json.loads(text)


@pytest.mark.slow
def test_trajectories__are_watched_side_by_side(page: str) -> None:
    shown, content = Page(page), played(page)
    assert shown.open == [] and "Passports" in shown.text
    assert [content["agents"][k] for k in content["shown"]] == ["PPO", "SAC"]
    titles = [world["title"] for world in content["worlds"]]
    assert titles[0] == "Scenario 1, as stated" and len(set(titles)) == 4


@pytest.mark.slow
@pytest.mark.parametrize("world", [0, 3])
def test_trajectories__passports_play_them_again(page: str, world: int) -> None:
    one = played(page)["worlds"][world]
    settings = tuple(Override.parse([one["why"].partition("--set ")[2]])) if one["why"] else ()
    again = Passport.parse(one["episodes"][0]["passport"]).replay(settings=settings)
    assert again.same and again.differences == ()


def test_page__of_a_result_without_episodes_has_no_player(settings: Reproduction) -> None:
    settings.make([planted("gaps", lambda s: made())])
    assert "data-episodes" not in (settings.folder / "index.html").read_text("utf-8")
