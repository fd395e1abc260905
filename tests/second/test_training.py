"""Trainings by the shipped recipes: both editions learn the same weights, to the bit, and measure the same."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.first_edition.training import recipe as first_recipe, session as first
from ethbrake_marl.training.recipe import load_recipe
from ethbrake_marl.training.train import train

LIST = {"every_updates": 3, "worlds": 200, "seed": 1007}
SHORT = {
    "ppo": ("ppo", "paper-random", {"total_steps": 7 * 8192}),
    "sac": ("sac", "paper-random", {"total_steps": 14_000, "evaluation": {**LIST, "every_updates": 50}}),
    "ppo-paper": ("ppo-paper", "paper-random", {"total_steps": 8 * 256, "n_steps": 256}),
    "obstacle": ("ppo", "paper-random-obstacle", {"total_steps": 2 * 8192}),
    "shared": ("cooperation-ppo", "cooperation-3-pair", {"total_steps": 3 * 16384}),
    "independent": ("cooperation-ppo", "cooperation-3-pair", {"total_steps": 3 * 16384, "scheme": "independent"}),
    "turns": (
        "cooperation-ppo",
        "cooperation-3-pair",
        {"total_steps": 8 * 4096, "n_envs": 32, "scheme": "independent", "turns": 2},
    ),
    "centralised": ("cooperation-ppo", "cooperation-3-pair", {"total_steps": 3 * 16384, "scheme": "centralised"}),
}


def weights(policies: Any) -> dict[str, np.ndarray]:
    """Return every tensor of policies, learner -> policy."""
    return {f"{who}.{name}": array for who, policy in policies.items() for name, array in policy.tensors.items()}


@pytest.mark.parametrize("case", SHORT)
def test_train__learns_the_weights_of_the_first_edition(case: str, tmp_path: Path) -> None:
    name, scenario, changes = SHORT[case]
    changes = {"evaluation": LIST, **changes}
    mine = train(load_recipe(name).replace(**changes), scenario, tmp_path / "mine", on_progress=None)
    theirs = first.train(
        first_recipe.load_recipe(name).replace(**changes), scenario, tmp_path / "theirs", on_progress=None
    )
    for found, expected in ((mine.last_policies, theirs.last.drivers), (mine.policies, theirs.trained.drivers)):
        found, expected = weights(found), weights(expected)
        assert found.keys() == expected.keys()
        different = [key for key in found if found[key].tobytes() != expected[key].tobytes()]
        assert not different, {key: float(np.abs(found[key] - expected[key]).max()) for key in different}
    first_policy, policy = next(iter(theirs.last.drivers.values())), next(iter(mine.last_policies.values()))
    kept, written = (each.manifest.model_dump(mode="json") for each in (first_policy, policy))
    for manifest in (kept, written):
        del manifest["versions"], manifest["manifest_sha256"]
    assert written == kept
    assert (mine.steps, mine.updates) == (theirs.steps, theirs.updates)
    for one, other in zip(mine.evaluations, theirs.evaluations, strict=True):
        measured = {key: value for key, value in one.items() if key != "cpu_s"}
        assert measured == pytest.approx(dict(other), rel=1e-12)
