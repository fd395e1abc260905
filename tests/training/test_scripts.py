"""The programs in train/: IPPO in one file, SuperSuit with PPO."""

import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

import ethbrake_marl as eb
from ethbrake_marl.policies.bundle import load_drivers
from tests.docs.site import load

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning", "ignore::FutureWarning")
PAIR = eb.load_scenario("cooperation-3-pair")


@pytest.fixture
def supersuit(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    pytest.importorskip("supersuit", reason="SuperSuit needs Python below 3.13")
    module = load("../../train/supersuit_ppo")
    monkeypatch.delitem(sys.modules, module.__name__)  # so that its functions are pickled as a script's are
    return module


def test_supersuit__worlds_are_seeded_and_no_two_copies_are_alike(supersuit: ModuleType) -> None:
    seen = []
    for seed in (5, 5, 6):
        worlds = supersuit.make_worlds(PAIR)
        worlds.seed(seed)
        seen.append(worlds.reset())
    assert seen[0].shape == (2 * supersuit.COPIES, 27)
    assert np.array_equal(seen[0], seen[1]) and not np.array_equal(seen[0], seen[2])
    assert len(np.unique(seen[0][::2], axis=0)) == supersuit.COPIES  # rows of Vehicle 2
    native = eb.make_sb3_vec_env(PAIR, 1, seed=5).reset()
    assert np.array_equal(seen[0][:2], native)  # copy 0 lives in the training worlds of its seed


FEW = {"steps": 200, "copies": 2, "rollout": 60, "minibatch": 64, "epochs": 1, "hidden": 8}


@pytest.mark.parametrize("name", ["cooperation-2-paper", "cooperation-4-all"])
def test_ippo__leaves_a_team_that_evaluates_and_is_the_same_twice(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    module, line = load("../../train/ippo"), eb.load_scenario(name)
    for folder, seed in (("one", 1), ("again", 1), ("other", 2)):
        module.train(module.Settings(scenario=name, seed=seed, **FEW), tmp_path / folder)
    assert "decisions: mean honest cost of an episode" in capsys.readouterr().out
    one, again, other = (load_drivers(tmp_path / folder / "policy") for folder in ("one", "again", "other"))
    assert [*one] == [f"vehicle_{body}" for body in line.learners]
    for vehicle, policy in one.items():
        assert policy.manifest == again[vehicle].manifest and policy.manifest.learners == (vehicle,)
        assert policy.manifest.weights_sha256 != other[vehicle].manifest.weights_sha256
        assert policy.manifest.reward["harm"] == 0.05
    result = eb.evaluate(line, {"braking": "full_brake", "mine": f"team@{tmp_path / 'one'}"}, episodes=20)
    assert (result["mine"]["first_impact_harm"] != result["braking"]["first_impact_harm"]).any()


def test_ippo__advantages_by_hand() -> None:
    """Two steps, the first of which ends an episode: A_1 = 2 - 1 + 0.5 (4 + 0) = 3; A_0 = 1 - 3 = -2."""
    module = load("../../train/ippo")
    settings = module.Settings(rollout=2, copies=1, gamma=0.5, gae_lambda=0.5)
    rollout, values = module.Rollout(1, settings), torch.tensor([[3.0], [1.0], [4.0]])
    rollout.rewards, rollout.ended = torch.tensor([[1.0], [2.0]]), torch.tensor([[1.0], [0.0]])
    assert module.advantages(rollout, values, settings).flatten().tolist() == [-2.0, 3.0]
    rollout.ended[0] = 0.0  # now the second step counts for the first: -2 + 0.5 (1 + 0.5 * 3) = -0.75
    assert module.advantages(rollout, values, settings).flatten().tolist() == [-0.75, 3.0]


@pytest.mark.slow
def test_ippo__learns_to_beat_full_braking(tmp_path: Path) -> None:
    module = load("../../train/ippo")
    module.train(module.Settings(steps=50_000, harm_count="first"), tmp_path)
    result = eb.evaluate(PAIR, {"braking": "full_brake", "mine": f"team@{tmp_path}"}, episodes=1000)
    braking, mine = (result[name]["first_impact_harm"].mean() for name in ("braking", "mine"))
    assert mine < 0.7 * braking
