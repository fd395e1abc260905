from __future__ import annotations

import re
import shlex
from dataclasses import replace

import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.episodes import MOST_CHARACTERS, Passport, follow_episodes
from ethbrake_marl.scenario import Scenario
from tests.pages.hostile import HOSTILE

SAFE = re.compile(r"[A-Za-z0-9:.,_@+/=%-]+")


@pytest.fixture(scope="module")
def passport(paper_random: Scenario) -> Passport:
    (motion,) = follow_episodes(paper_random.sample(1, 7).worlds, make_agent("full_brake"), paper_random)
    return Passport.of(motion, paper_random, "full_brake", seed=7, number=0)


@pytest.mark.parametrize(
    "agent",
    ["full_brake", "ppo@shipped+refined+step", "constant:3.5", "my_file.py:make_agent", "ppo@runs/my run", "ä~b"],
)
def test_passport__is_read_as_it_was_written(passport: Passport, agent: str) -> None:
    for other in (passport, replace(passport, seed=None), replace(passport, harm_count="total", vehicles=(0, 2))):
        given = replace(other, agent=agent)
        assert Passport.parse(str(given)) == given
        assert Passport.parse(f"  {given}\n") == given


@pytest.mark.parametrize("agent", HOSTILE)
def test_passport__is_short_and_no_shell_touches_it(passport: Passport, agent: str) -> None:
    text = str(replace(passport, agent=agent))
    assert len(text) <= MOST_CHARACTERS
    assert SAFE.fullmatch(text)
    assert shlex.quote(text) == text
    assert Passport.parse(text).agent in (agent, "...")


def test_passport__of_long_names_leaves_out_what_it_must(passport: Passport) -> None:
    long = replace(passport, scenario="a" * 64, agent=f"ppo@{'runs/' * 40}+refined+step")
    assert Passport.parse(str(replace(passport, agent=long.agent))).agent == "ppo@...+refined+step"
    assert len(str(long)) <= MOST_CHARACTERS
    assert Passport.parse(str(long)).scenario == "a" * 30 + "..."


def test_passport__a_typo_is_told_from_another_kind_of_text(passport: Passport) -> None:
    text = str(passport)
    for k in range(4, len(text)):
        typo = text[:k] + ("x" if text[k] != "x" else "y") + text[k + 1 :]
        with pytest.raises(InvalidInput, match="a typo"):
            Passport.parse(typo)
    for cut in (text[:-1], text[: len(text) // 2], text + "0"):
        with pytest.raises(InvalidInput, match="a typo, or a part is missing"):
            Passport.parse(cut)
    with pytest.raises(InvalidInput, match="another kind"):
        Passport.parse("EB9" + text[3:])
    for other in ("", "hello", "../../etc/passwd", "<script>", "EB"):
        with pytest.raises(InvalidInput, match="is no passport"):
            Passport.parse(other)


def test_passport__says_what_differs(passport: Passport) -> None:
    assert passport.differences(passport) == []
    changed = {
        "scenario_sha": ("0" * 10, "the scenario"),
        "versions": (("9.9.9", *passport.versions[1:]), "ethbrake-marl: 9.9.9 here"),
        "world_sha": ("0" * 6, "the world"),
        "policy_sha": ("0" * 8, "the policy"),
        "episode_sha": ("0" * 10, "the episode"),
    }
    for name, (value, words) in changed.items():
        (told,) = passport.differences(replace(passport, **{name: value}))
        assert words in told
