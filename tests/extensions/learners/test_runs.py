"""Whole trainings: the weights of version 0.5, going on after a kill, shipped recipes, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl as eb
from ethbrake_marl.errors import UnknownName
from ethbrake_marl.policies.bundle import load_shipped
from ethbrake_marl.training.recipe import load_recipe, shipped_recipes
from ethbrake_marl.training.train import resume, train
from tests.extensions.learners.tiny import OWN, PAIR, PAPER, VINE, fingerprint
from tests.refused import refused
from tests.training.tiny import dying_after, kept, killed


def begin(run: Path, **settings: Any) -> Any:
    return train(VINE.replace(reward=OWN), PAIR, run, **{"on_progress": None, **settings})


def test_training__learns_the_weights_of_version_0_5_also_after_a_kill(tmp_path: Path) -> None:
    """Rounding differs between processors, so the weights are compared with a tolerance."""
    result = begin(tmp_path / "whole")
    assert fingerprint(result.last_policies) == pytest.approx([0.0992646, 46.9787, 0.022246, 0.156827], rel=1e-3)
    assert result.evaluations[-1]["total_harm"] == pytest.approx(144.39235738133806, rel=1e-3)
    killed(begin, tmp_path / "run", on_progress=dying_after(3))
    assert resume(tmp_path / "run", on_progress=None).status == "finished"
    assert kept(tmp_path / "run") == kept(tmp_path / "whole")


AMPLE = {
    "n_envs": 64, "n_steps": 8, "tried": 256, "batch_size": 64, "learning_rate": {"start": 3e-3, "end": 3e-3},
    "evaluation": {"every_updates": 1000, "worlds": 300, "seed": 7}, "network": {"policy": [32]},
    "total_steps": 30 * 512,
}  # fmt: skip


@pytest.mark.slow
def test_training__gets_better_from_scratch(tmp_path: Path) -> None:
    first, *_, last = train(VINE.replace(**AMPLE), PAPER, tmp_path / "run", on_progress=None).evaluations
    assert last["first_impact_harm"] < 0.7 * first["first_impact_harm"]


RECIPES = [name for name, file in shipped_recipes().items() if file.parent.name == "learners"]


@pytest.mark.slow
@pytest.mark.parametrize("name", RECIPES)
def test_shipped_recipe__trains_for_one_update(name: str, tmp_path: Path) -> None:
    recipe = load_recipe(name)
    few = recipe.replace(n_envs=-(-max(recipe.batch_size, recipe.tried) // recipe.rounds), total_steps=1)
    scenario = recipe.scenario or {"vine": "paper-random"}.get(name, "cooperation-1-front")
    result = train(few, scenario, tmp_path / "run", measure=None, on_progress=None)
    assert result.updates == 1 and eb.load_policy(tmp_path / "run").manifest.algorithm == recipe.algorithm


def start(name: str, **changes: Any) -> Callable[[], object]:
    recipe = load_recipe("vine").replace(start=name, **changes)
    return lambda: train(recipe, "paper-random", "new", measure=None, on_progress=None)


REFUSED: dict[str, Callable[[], object]] = {
    "reward.shaping = 0.1: must be 0: this algorithm plays tried actions to the end": lambda: VINE.replace(
        reward={"harm": 1.0, "shaping": 0.1}
    ),
    "n_envs x n_steps = 16777216 decisions per update are too many (at most 4194304)": lambda: VINE.replace(
        n_envs=2**22
    ),
    "tried = 33: must be at most n_envs x n_steps = 32": lambda: VINE.replace(tried=33),
    "scheme independent: the algorithm vine": lambda: train(VINE, PAIR, "new", scheme="independent"),
    "runs/mine: is not a folder; give the folder of a policy bundle": start("ppo@runs/mine"),
    "recipe 'vine': start: full_brake: must name a trained policy, such as ppo or policy@PATH": start("full_brake"),
    "observation lacks the features rear_1.known, rear_1.gap": start("ppo", observation=["own", "front_1", "contact"]),
}


@pytest.mark.parametrize("message", REFUSED)
def test_recipe_or_training__is_refused(message: str, empty_folder: Path) -> None:
    load_shipped("ppo").save("first")
    with refused(message):
        REFUSED[message]()


def test_policy_to_start_from__is_one_that_ships(empty_folder: Path) -> None:
    with refused("unknown agent 'nobody'", UnknownName):
        start("nobody")()
