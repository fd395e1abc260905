"""``--full``: what is trained, that it goes on, and curves made of what is finished."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.figures import SeedCurve
from ethbrake_marl.learning.training import load_recipe
from ethbrake_marl.studies import reproduction
from ethbrake_marl.studies.reproduction import ITEMS, Course, Group, Reproduction, TrainedRecipe
from tests.learning.tiny import TINY_PPO

from .conftest import made, planted

TINY = TINY_PPO.replace(total_steps=128 * 8, evaluation={"every_updates": 1, "worlds": 5, "seed": 7})


@pytest.fixture
def tiny_groups(monkeypatch: pytest.MonkeyPatch) -> None:
    """One training of a second at either delay, in the place of all."""
    trained = {"ppo": (TrainedRecipe("ppo", TINY.total_steps, 1, 1000), TINY)}
    groups = {delay: Group(delay, f"paper-delay-{delay}", trained, 1) for delay in ("low", "high")}
    monkeypatch.setattr(reproduction, "groups", lambda: groups)
    monkeypatch.setattr(reproduction, "CURVES", {"low": ("low",), "high": ("high",)})


@pytest.mark.usefixtures("undrawn")
def test_full__trains_draws_and_keeps_what_is_trained(tiny_groups, settings: Reproduction) -> None:
    full = replace(settings, mode="full", episodes=5)
    (item,) = Reproduction.choose(["learning-low"])
    small = replace(item, trained=("low", "high"))
    assert full.seconds_left(small.trained) == pytest.approx(2 * 1.024)
    (result,), finished = full.make([small])
    assert finished and result.trained == ["low/ppo", "high/ppo"]
    assert [each.stem for each in result.figures] == ["learning-low-ours"]
    assert "1 seeds of ppo to 1,024 decisions" in result.notes[0] and "sac" in result.notes[1]
    (higher,) = [each for each in result.comparisons if each.what.startswith("both algorithms reach higher")]
    assert higher.outcome in ("agrees", "differs")
    assert full.seconds_left(small.trained) == 0.0
    before = sorted(path.stat().st_mtime_ns for path in (full.folder / "trainings").rglob("run.json"))
    full.make([small], force=True)
    assert sorted(path.stat().st_mtime_ns for path in (full.folder / "trainings").rglob("run.json")) == before


def test_full__interrupted_makes_the_items_of_what_is_finished(settings: Reproduction, monkeypatch) -> None:
    asked = []
    monkeypatch.setattr(Reproduction, "train", lambda *given: bool(asked.append(given)))
    chosen = [replace(planted("gaps", lambda s: made()), trained=("open",)), planted("harm-delays", lambda s: made())]
    results, finished = replace(settings, mode="full").make(chosen)
    assert not finished and len(asked) == 1
    assert [each.name for each in results] == ["harm-delays", "gaps"]


def test_full__an_item_is_made_again_when_more_is_trained(settings: Reproduction, monkeypatch) -> None:
    trained: dict[str, list[Path]] = {}
    monkeypatch.setattr(Reproduction, "train", lambda *given: True)
    monkeypatch.setattr(Reproduction, "trained", lambda *given: trained)
    calls = []
    chosen = [replace(planted("gaps", lambda s: calls.append(1) or made()), trained=("open",))]
    for expected in (1, 1):
        replace(settings, mode="full").make(chosen)
        assert len(calls) == expected
    trained["open/ppo-paper"] = []
    replace(settings, mode="full").make(chosen)
    assert len(calls) == 2


def test_groups__fit_their_recipes_and_every_item_names_groups_that_exist() -> None:
    found = reproduction.groups()
    assert {name for item in ITEMS for name in item.trained} == set(found)
    for group in found.values():
        for name, (asked, recipe) in group.trained.items():
            assert recipe.name == name and recipe.total_steps == asked.decisions
            stated = load_recipe(asked.recipe)
            if asked.recipe.endswith("-paper"):  # the paper's table stays as it is
                for key in ("gamma", "batch_size", "network"):
                    assert getattr(recipe, key) == getattr(stated, key)


def test_cost__is_told_before_and_at_most_an_hour(tmp_path: Path) -> None:
    settings = Reproduction("full", tmp_path)
    assert "trainings before them about" in settings.cost(ITEMS)
    assert 600.0 < settings.seconds_left(list(reproduction.groups())) <= 3_600.0
    assert "trainings" not in replace(settings, mode="quick").cost(ITEMS)
    assert settings.trained(["low"]) == {}


def course(returns: list[list[float]], harm: list[list[float]]) -> Course:
    steps = np.arange(len(returns[0]), dtype=float)
    return Course(SeedCurve(steps, np.array(returns)), SeedCurve(steps, np.array(harm)))


def test_course__measures_of_planted_curves() -> None:
    one = course([[-10.0, -4.0, 0.0, 0.0], [-10.0, -6.0, 0.0, 0.0]], [[100.0, 50.0, 10.0, 0.0], [100.0, 5.0, 1.0, 0.0]])
    assert one.last_returns.tolist() == [0.0, 0.0]
    assert one.rise == 10.0
    assert one.decisions_to_converge.tolist() == [2.0, 1.0]
    assert one.spread.tolist() == [0.0, 0.0]
    assert one.unrest(2).tolist() == [0.0, 0.0]
    assert one.unrest(3).tolist() == pytest.approx([0.1, 0.15])  # changes of 2 and 0, 3 and 0
    assert one.still_rising == 0.0
    assert course([[-4.0, -3.0, -2.0, -1.0, 0.0]], [[1.0] * 5]).still_rising == pytest.approx(0.25)


def test_returns__of_a_shaped_reward_say_nothing_between_delays_so_its_harm_is_compared() -> None:
    worse = course([[-9.0] * 20, [-8.99] * 20], [[90.0] * 20, [80.0] * 20])
    better = course([[-10.0] * 20, [-9.99] * 20], [[10.0] * 20, [8.0] * 20])  # of lower returns
    for recipe, outcome, told in (("ppo", "agrees", "minus its harm"), ("ppo-paper", "differs", "ppo-paper")):
        assert bool(load_recipe(recipe).reward.shaping) == (recipe == "ppo")
        verdict = reproduction._higher_when_low({"high": {recipe: worse}, "low": {recipe: better}})
        assert (verdict.outcome, told in verdict.because) == (outcome, True)
