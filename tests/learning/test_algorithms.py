"""An algorithm from the user's own file: the one on the page about learning, as it is printed there."""

from __future__ import annotations

import importlib
import json
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

import ethbrake_marl as eb
from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.errors import InvalidInput, Progress
from ethbrake_marl.learning import training as registry
from ethbrake_marl.learning.algorithms import Ppo
from ethbrake_marl.learning.runs import resume, train
from ethbrake_marl.learning.training import (
    PpoRecipe,
    RunDirectory,
    TrainingRecipe,
    algorithm_names,
    load_recipe,
    register_algorithm,
)
from ethbrake_marl.policies import load_policy
from tests.learning.tiny import TINY_PPO

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "learning.md").read_text("utf-8")
SCENARIO = eb.load_scenario("paper-random")
RECIPE: dict[str, Any] = {
    **TINY_PPO.model_dump(mode="json", include=set(TrainingRecipe.model_fields)),
    "name": "mine",
    "algorithm": "a2c",
    "total_steps": 3072,
    "n_steps": 8,
    "network": {"policy": [8], "value": [8]},
    "evaluation": {"every_updates": 10, "worlds": 10, "seed": 7},
    "checkpoint_every_updates": 5,
}


@pytest.fixture(autouse=True)
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The page's file, imported; what it registers is forgotten afterwards."""
    monkeypatch.setattr(registry, "_ALGORITHMS", dict(registry._ALGORITHMS))
    (source,) = (block for block in re.findall("```python\n(.*?)```", PAGE, re.DOTALL) if "register_algorithm" in block)
    (tmp_path / "my_algorithm.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    importlib.import_module("my_algorithm")
    yield
    sys.modules.pop("my_algorithm")


def _file(folder: Path, **changes: Any) -> Path:
    path = folder / "mine.yaml"
    path.write_text(yaml.safe_dump({**RECIPE, **changes}))
    return path


def _weights(run: Path) -> list[bytes]:
    return [(run / name / "weights.safetensors").read_bytes() for name in ("policy", "policy-last")]


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_own_algorithm__trains_resumes_bit_for_bit_and_is_evaluated(tmp_path: Path) -> None:
    recipe = _file(tmp_path)
    whole = train(recipe, SCENARIO, tmp_path / "whole")
    assert (whole.status, whole.steps, whole.updates) == ("finished", 3072, 48)

    def ctrl_c(progress: Progress) -> None:
        if progress.updates == 23:
            signal.raise_signal(signal.SIGINT)

    stopped = train(recipe, SCENARIO, tmp_path / "run", on_progress=ctrl_c)
    assert stopped.status == "interrupted" and stopped.updates < 48
    assert list((tmp_path / "run" / "checkpoints").iterdir())
    result = resume(tmp_path / "run")
    assert (result.status, result.evaluations) == ("finished", whole.evaluations)
    assert _weights(tmp_path / "run") == _weights(tmp_path / "whole")

    policy = load_policy(tmp_path / "run")
    assert policy.manifest.algorithm == "a2c"
    agents = {"mine": LearnedAgent(policy, "mine"), "team": RunDirectory(tmp_path / "run").load_team(SCENARIO)}
    found = eb.evaluate(SCENARIO.sample(10, 7), agents, scenario=SCENARIO)
    harms = [found.outcome(name).first_impact_harm.mean() for name in agents]
    assert harms[0] == harms[1] == pytest.approx(min(e["first_impact_harm"] for e in result.evaluations))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_own_algorithm__under_vec_normalize_is_refused_as_no_bundle_holds_its_statistics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from stable_baselines3.common.vec_env import VecNormalize

    own = sys.modules["my_algorithm"].A2c
    build = own.build
    monkeypatch.setattr(own, "build", lambda self, training, rows: build(self, training, VecNormalize(rows)))
    with pytest.raises(InvalidInput, match="'a2c': its model is trained under VecNormalize, whose statistics are no"):
        train(_file(tmp_path), SCENARIO, tmp_path / "run")


def test_own_algorithm__its_class_checks_the_recipe(tmp_path: Path) -> None:
    loaded = load_recipe(_file(tmp_path))
    assert type(loaded).__name__ == "A2cRecipe" and loaded.rounds == 8
    with pytest.raises(InvalidInput, match=r"mine.yaml, line \d+: n_stepz.*did you mean n_steps"):
        load_recipe(_file(tmp_path, n_stepz=3))
    with pytest.raises(InvalidInput, match=r"mine.yaml, line \d+: n_steps = 2.5: must be a whole number"):
        load_recipe(_file(tmp_path, n_steps=2.5))
    with pytest.raises(InvalidInput, match=r"algorithm = a3c: must be ppo or sac or counterfactual or a2c"):
        load_recipe(_file(tmp_path, algorithm="a3c"))
    with pytest.raises(InvalidInput, match="scheme independent: recipe 'mine' is for A2C; it needs one for PPO"):
        train(loaded, "cooperation-3-pair", tmp_path / "run", scheme="independent")


@pytest.mark.parametrize(
    ("name", "recipe", "algorithm", "message"),
    [
        ("ppo", PpoRecipe, Ppo, "algorithm 'ppo': is registered already; give another name"),
        ("a2c", PpoRecipe, Ppo, "algorithm 'a2c': is registered already"),
        ("My algorithm", PpoRecipe, Ppo, "algorithm 'My algorithm': must be 1 to 64 of a-z, 0-9, - and _"),
        ("new", dict, Ppo, "algorithm 'new': recipe = <class 'dict'>: must be a class with network_spec"),
        ("new", PpoRecipe, Ppo(), "algorithm 'new': algorithm = .*: must be a class with build"),
    ],
)
def test_register__refuses_what_cannot_be_used(name: str, recipe: Any, algorithm: Any, message: str) -> None:
    with pytest.raises(InvalidInput, match=message):
        register_algorithm(name, recipe, algorithm)
    assert algorithm_names() == ("ppo", "sac", "counterfactual", "a2c")


def test_checkpoint__of_the_own_algorithm_that_was_changed_is_refused(tmp_path: Path) -> None:
    config = tmp_path / "run" / "config.json"

    def ctrl_c(progress: Progress) -> None:
        if progress.updates == 10:
            signal.raise_signal(signal.SIGINT)

    train(_file(tmp_path), SCENARIO, tmp_path / "run", on_progress=ctrl_c, measure=None)
    content = json.loads(config.read_text())
    config.write_text(json.dumps({**content, "recipe": {**content["recipe"], "n_steps": 4}}))
    with pytest.raises(InvalidInput, match="was changed after the checkpoint"):
        resume(tmp_path / "run", measure=None)
