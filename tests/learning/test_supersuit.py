"""train/supersuit_ppo.py: the traps are closed, and it learns."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

import ethbrake_marl as eb
from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.policies import load_policy

SCRIPT = Path(__file__).resolve().parents[2] / "train" / "supersuit_ppo.py"
PAIR = eb.load_scenario("cooperation-3-pair")

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning")


@pytest.fixture
def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("supersuit_ppo", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_worlds__are_seeded_and_no_two_copies_are_alike(script: ModuleType) -> None:
    first, again, other = (script.make_worlds(PAIR) for _ in range(3))
    for worlds, seed in ((first, 5), (again, 5), (other, 6)):
        worlds.seed(seed)
    seen, same, different = first.reset(), again.reset(), other.reset()
    assert seen.shape == (2 * script.COPIES, 27)
    assert np.array_equal(seen, same)
    assert not np.array_equal(seen, different)
    assert len(np.unique(seen[::2], axis=0)) == script.COPIES  # rows of Vehicle 2
    native = eb.make_sb3_vec_env(PAIR, 1, seed=5).reset()
    assert np.array_equal(seen[:2], native)  # copy 0 lives in the training worlds of its seed


def test_worlds__tell_which_episodes_the_horizon_cut_off(script: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(script, "COPIES", 4)
    worlds = script.make_worlds(PAIR)
    worlds.seed(1)
    worlds.reset()
    ends: list[tuple[bool, bool]] = []
    for _ in range(85):
        _, _, done, infos = worlds.step(np.ones((worlds.num_envs, 1), np.float32))  # drive on: never at rest
        ends += [(bool(d), info.get("TimeLimit.truncated", False)) for d, info in zip(done, infos, strict=True) if d]
        assert all(info["terminal_observation"].shape == (27,) for d, info in zip(done, infos, strict=True) if d)
    assert ends and all(end == (True, True) for end in ends)
    ends.clear()
    for _ in range(160):
        _, _, done, infos = worlds.step(-np.ones((worlds.num_envs, 1), np.float32))  # brake: at rest before the horizon
        ends += [(bool(d), info.get("TimeLimit.truncated", False)) for d, info in zip(done, infos, strict=True) if d]
    assert (True, False) in ends


@pytest.mark.long
def test_supersuit__learns_to_beat_full_braking(script: ModuleType, tmp_path: Path) -> None:
    threads = torch.get_num_threads()
    script.train(PAIR, 200_000, 0, tmp_path / "run")
    torch.set_num_threads(threads)
    agents = {"full_brake": eb.make_agent("full_brake"), "ppo": LearnedAgent(load_policy(tmp_path / "run"))}
    result = eb.evaluate(PAIR.sample(1000, 7), agents, scenario=PAIR)
    harm = {name: result.outcome(name).first_impact_harm.mean() for name in agents}
    assert harm["ppo"] < 0.9 * harm["full_brake"]
