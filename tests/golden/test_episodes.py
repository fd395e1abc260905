"""Episodes of the shipped scenarios, recorded from version 0.5: they must stay as they are.

``episodes.json`` has digests of every bit, ``episodes.npz`` numbers: where only a digest differs, rounding has changed.
``python -m tests.golden.test_episodes`` records them anew.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ethbrake_marl.agent_names import open_game
from ethbrake_marl.motion.layout import PUSHED
from ethbrake_marl.worlds.catalogue import load_scenario
from tests.fixtures.scenarios import SHIPPED

DIGESTS, NUMBERS = (Path(__file__).with_name(f"episodes.{end}") for end in ("json", "npz"))
RECORDED = json.loads(DIGESTS.read_text("utf-8")) if DIGESTS.exists() else {}
N = 10
REWARDS: dict[str, Any] = {
    "paper": "paper-reward",
    "ppo": {"harm": 0.05, "harm_count": "first", "terminal": 0.02, "shaping": 0.05, "shaping_discount": 0.995},
    **{
        objective: {"harm": 1.0, "harm_count": "total", "objective": objective}
        for objective in ("own", "social:45", "maximin", "weighted:1,4,1")
    },
}


def played(name: str, reward: Any = "first-impact-harm") -> tuple[str, dict[str, np.ndarray]]:
    _, game = open_game(name, reward=reward)
    state, rng, sha256 = game.reset(load_scenario(name).sample(N, 7)), np.random.default_rng(7), hashlib.sha256()
    sums = np.zeros((N, state.vehicles))
    while not state.ended.all():
        actions = rng.integers(-8, 9, (N, len(game.settings.learners))) / 8.0
        state, step = game.step(state, actions)
        seen = game.observe(state, game.settings.learners)
        for array in (state.line[:, :PUSHED], state.clock[:, :5], step.reward, *seen):
            sha256.update(np.ascontiguousarray(array, array.dtype.newbyteorder("<")).tobytes())
        sums += step.reward
    observed = {f"observation_{i}": array for i, array in zip(game.settings.learners, seen, strict=True)}
    return sha256.hexdigest()[:16], {"line": np.minimum(state.line[:, :PUSHED], 1e9), "rewards": sums, **observed}


@cache
def cases() -> dict[str, tuple[str, Any]]:
    return {
        **{name: (name, "first-impact-harm") for name in SHIPPED if load_scenario(name).learners},
        **{f"paper-random-obstacle, {name}": ("paper-random-obstacle", reward) for name, reward in REWARDS.items()},
    }


def test_every_scenario_with_learners__is_recorded() -> None:
    assert cases().keys() <= RECORDED.keys()


@pytest.mark.parametrize("name", [name for name in RECORDED if name.partition(",")[0] in SHIPPED])
def test_episodes__are_those_of_the_record(name: str) -> None:
    digest, arrays = played(*cases()[name])
    with np.load(NUMBERS) as recorded:
        for key, array in arrays.items():
            np.testing.assert_allclose(array, recorded[f"{name}/{key}"], rtol=1e-9, atol=1e-9, err_msg=key)
    assert digest == RECORDED[name]


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    found = {name: played(*case) for name, case in cases().items()}
    DIGESTS.write_text(json.dumps({name: digest for name, (digest, _) in found.items()}, indent=1) + "\n", "utf-8")
    np.savez_compressed(
        NUMBERS, **{f"{n}/{key}": array for n, (_, each) in found.items() for key, array in each.items()}
    )
