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
from tests.extensions.learners.tiny import OWN, PAIR, PAPER, ROLLOUTS, VINE, fingerprint
from tests.refused import refused
from tests.training.tiny import dying_after, kept, killed

TRAININGS: dict[str, tuple[Any, Any]] = {
    "vine": (VINE.replace(reward=OWN), PAIR),
    "rollouts": (ROLLOUTS.replace(reward=OWN), PAIR),
}


def begin(name: str, run: Path, **settings: Any) -> Any:
    return train(*TRAININGS[name], run, **{"on_progress": None, **settings})


# recorded from version 0.5
GOLDEN = {
    "vine": ([0.0992646, 46.9787, 0.022246, 0.156827], 144.39235738133806),
    "rollouts": ([0.879668, 20.5613, 0.141928, 0.430946], 49.66282439932783),
}
ENDED: dict[str, dict[str, Any]] = {}  # name -> what its training has left


@pytest.mark.parametrize("name", TRAININGS)
def test_training__learns_the_weights_that_it_always_has(name: str, tmp_path: Path) -> None:
    """Rounding differs between processors, so not to the bit; ``progress.csv`` and policies are kept for below."""
    result = begin(name, tmp_path / "run")
    weights, harm = GOLDEN[name]
    assert fingerprint(result.last_policies) == pytest.approx(weights, rel=1e-3)
    assert result.evaluations[-1]["total_harm"] == pytest.approx(harm, rel=1e-3)
    ENDED[name] = kept(tmp_path / "run")


@pytest.mark.parametrize(("name", "updates"), [("vine", 3), ("rollouts", 4)])
def test_resume__after_a_kill_everything_is_the_same(name: str, updates: int, tmp_path: Path) -> None:
    if name not in ENDED:
        begin(name, tmp_path / "whole")
        ENDED[name] = kept(tmp_path / "whole")
    killed(begin, name, tmp_path / "run", on_progress=dying_after(updates))
    assert resume(tmp_path / "run", on_progress=None).status == "finished"
    assert kept(tmp_path / "run") == ENDED[name]


AMPLE = {
    "n_envs": 64, "n_steps": 8, "tried": 256, "batch_size": 64, "learning_rate": {"start": 3e-3, "end": 3e-3},
    "evaluation": {"every_updates": 1000, "worlds": 300, "seed": 7},
}  # fmt: skip
LEARNERS = {
    "vine": VINE.replace(**AMPLE, network={"policy": [32]}, total_steps=30 * 512),
    "rollouts": ROLLOUTS.replace(
        **AMPLE, network={"policy": [32], "choices": 9}, total_steps=12 * 512, memory=4000, gradient_steps=60
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LEARNERS)
def test_training__gets_better_from_scratch(name: str, tmp_path: Path) -> None:
    first, *_, last = train(LEARNERS[name], PAPER, tmp_path / "run", on_progress=None).evaluations
    assert last["first_impact_harm"] < 0.7 * first["first_impact_harm"]


RECIPES = [name for name, file in shipped_recipes().items() if file.parent.name == "learners"]


@pytest.mark.parametrize("name", RECIPES)
def test_shipped_recipe__is_like_its_own_content(name: str) -> None:
    base = load_recipe(name)
    assert load_recipe(base.model_dump(mode="json")) == base


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
    "algorithm = trpo: must be one of ppo, sac": lambda: VINE.replace(algorithm="trpo"),
    "reward.shaping = 0.1: must be 0: this algorithm plays tried actions to the end": lambda: VINE.replace(
        reward={"harm": 1.0, "shaping": 0.1}
    ),
    "offset.largest = 0.1: must be at least the value of the key smallest, 0.3": lambda: VINE.replace(
        offset={"smallest": 0.3, "largest": 0.1}
    ),
    "n_envs x n_steps = 16777216 decisions per update are too many (at most 4194304)": lambda: VINE.replace(
        n_envs=2**22
    ),
    "tried = 33: must be at most n_envs x n_steps = 32": lambda: VINE.replace(tried=33),
    "memory = 15: must be at least tried, which is 16": lambda: ROLLOUTS.replace(memory=15),
    "near = []: must contain a range, because the recipe has no fixed": lambda: ROLLOUTS.replace(
        near=[], fixed=[], drawn=0
    ),
    "scheme independent: the algorithm vine": lambda: train(VINE, PAIR, "new", scheme="independent"),
    "runs/mine: is not a folder; give the folder of a policy bundle": start("ppo@runs/mine"),
    "agent 'vine@first': the policy was trained by ppo; write ppo@first": start("vine@first"),
    "recipe 'vine': start: full_brake: must name a trained policy, such as ppo or policy@PATH": start("full_brake"),
    "observation lacks the features rear_1.known, rear_1.gap": start("ppo", observation=["own", "front_1", "contact"]),
    "network.policy_hidden is (64, 64), but must be (128, 128), as in the policy": start(
        "ppo", network={"policy": [64, 64]}
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_recipe_or_training__is_refused(message: str, empty_folder: Path) -> None:
    load_shipped("ppo").save("first")
    with refused(message):
        REFUSED[message]()


def test_policy_to_start_from__is_one_that_ships(empty_folder: Path) -> None:
    with refused("unknown agent 'nobody'", UnknownName):
        start("nobody")()
