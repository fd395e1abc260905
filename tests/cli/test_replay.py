from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.evaluation.episodes import Passport, follow_episodes
from ethbrake_marl.scenario import load_scenario, new_scenario_text
from tests.pages.hostile import HOSTILE, UNSEEN


def passport_of(spec: str, scenario_name: str | Path = "paper-random", *, seed: int | None = 7, world: int = 3) -> str:
    scenario = load_scenario(scenario_name)
    agent = make_agent(spec, scenario=scenario)
    worlds = scenario.sample(1, 7, first=world).worlds
    (motion,) = follow_episodes(worlds, agent, scenario)
    return str(Passport.of(motion, scenario, spec, seed=seed, number=world))


def test_replay__is_the_same_episode_bit_for_bit(ethbrake):
    for spec in ("full_brake", "constant:4.5"):
        answer = ethbrake("watch", "replay", passport_of(spec))
        assert answer.status == 0, answer.err
        assert "The same episode, bit for bit." in answer.out
        assert "Differs" not in answer.out


def test_cli_page__shows_a_passport_that_can_be_replayed(ethbrake):
    page = (Path(__file__).parents[2] / "docs" / "cli.md").read_text("utf-8")
    found = re.search(r"\$ ethbrake watch replay (EB1:\S+)\n(.+)\n", page)
    assert found is not None
    answer = ethbrake("watch", "replay", found[1])
    assert answer.status == 0 and answer.out.startswith(found[2])


def test_replay__writes_a_page_and_a_film(ethbrake, tmp_path):
    text = passport_of("full_brake")
    page, film = tmp_path / "again.html", tmp_path / "again.gif"
    assert ethbrake("watch", "replay", text, "--output", page).status == 0
    assert text in page.read_text() and "bit for bit" in page.read_text()
    assert ethbrake("watch", "replay", text, "--output", film).status == 0
    assert film.read_bytes().startswith(b"GIF89a")
    refused = ethbrake("watch", "replay", text, "--output", page)
    assert refused.status == 2 and "--force" in refused.err
    assert ethbrake("watch", "replay", text, "--output", tmp_path / "again.txt").status == 2


def test_replay__says_that_the_scenario_was_edited(ethbrake, tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(new_scenario_text("mine"))
    text = passport_of("full_brake", path)
    missing = ethbrake("watch", "replay", text)
    assert missing.status == 2 and "--scenario FILE.yaml" in missing.err
    assert ethbrake("watch", "replay", text, "--scenario", path).status == 0
    edited = path.read_text().replace("restitution: 0.1", "restitution: 0.2")
    assert edited != path.read_text()
    path.write_text(edited)
    answer = ethbrake("watch", "replay", text, "--scenario", path, "--json")
    told = json.loads(answer.out)
    assert answer.status == 1 and told["same"] is False
    assert any(each.startswith("the scenario") for each in told["differences"])
    assert ethbrake("watch", "replay", text, "--scenario", path, "--set", "restitution=0.1").status == 0


def test_replay__runs_no_code_that_only_the_passport_names(ethbrake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(
        "from pathlib import Path\nimport ethbrake_marl as eb\nPath('ran').touch()\n"
        "def make_agent():\n    return eb.make_agent('coast')\n"
    )
    text = passport_of("mine.py:make_agent")
    Path("ran").unlink()
    refused = ethbrake("watch", "replay", text)
    assert refused.status == 2 and "--agent mine.py:make_agent" in refused.err
    assert not Path("ran").exists()
    assert ethbrake("watch", "replay", text, "--agent", "mine.py:make_agent").status == 0


def test_replay__says_what_is_missing(ethbrake, tmp_path):
    path = Path(__file__)
    for changed, words in {
        passport_of("full_brake", seed=None): "--initial-states FILE.csv",
        passport_of("full_brake")[:-1] + "z": "a typo",
        "hello": "is no passport",
    }.items():
        answer = ethbrake("watch", "replay", changed)
        assert answer.status == 2 and words in answer.err and answer.err.count("\n") == 1
    answer = ethbrake("watch", "replay", passport_of("full_brake"), "--initial-states", path)
    assert answer.status == 2 and "leave --initial-states out" in answer.err


@pytest.mark.parametrize(
    "text", [pytest.param(text, marks=pytest.mark.slow if k % 6 else ()) for k, text in enumerate(HOSTILE)]
)
def test_replay__of_anything_else_is_refused_in_one_line(ethbrake, tmp_path, monkeypatch, text):
    monkeypatch.chdir(tmp_path)
    passport = str(EXAMPLE)
    for given in (text, "EB1:" + text, passport.replace("paper-random", text), f"{passport[:-6]}{text}"):
        answer = ethbrake("watch", "replay", "--", given)
        assert answer.status == 2 and answer.err.count("\n") == 1
        assert not set(answer.err[:-1]) & UNSEEN
    made = str(replace(EXAMPLE, agent=text))
    answer = ethbrake("watch", "replay", made)
    assert answer.status == 2 and answer.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


EXAMPLE = Passport(
    "paper-random",
    "0" * 10,
    7,
    3,
    "first",
    (1,),
    ("0.1.0", "3.11.7", "0.68.1", "2.4.6"),
    "0" * 6,
    "0" * 10,
    None,
    "coast",
)


@pytest.mark.usefixtures("undrawn")
def test_evaluate_report__its_passports_can_be_replayed(ethbrake, tmp_path):
    page = tmp_path / "report.html"
    answer = ethbrake("evaluate", "--agents", "full_brake,constant:3+step", "--episodes", "12", "--report", page)
    assert answer.status == 0, answer.err
    text = page.read_text()
    passports = [each.partition('"')[0] for each in text.split('"passport":"')[1:]]
    assert len(passports) == len(set(passports)) == 24
    for passport in (passports[0], passports[-1]):
        assert "bit for bit" in ethbrake("watch", "replay", passport).out
    assert "minus episode mode" in text
    refused = ethbrake("evaluate", "--episodes", "1", "--report", page)
    assert refused.status == 2 and "--force" in refused.err
    assert ethbrake("evaluate", "--episodes", "1", "--report", tmp_path / "report.pdf").status == 2


def test_film__of_another_ending_is_refused_before_anybody_is_asked_for(ethbrake, tmp_path):
    answer = ethbrake("watch", "record", "--agents", "nobody", "--output", str(tmp_path / "x.txt"))
    assert answer.status == 2 and "films are written as" in answer.err and "nobody" not in answer.err
