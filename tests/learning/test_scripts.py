"""The scripts below train/: BenchMARL's MAPPO, SuperSuit with PPO, and a clone of a dataset."""

import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import ethbrake_marl as eb
from tests.docs.site import load
from tests.learning.tiny import harm_beside_full_braking

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning", "ignore::FutureWarning")
PAPER, PAIR = eb.load_scenario("paper-random"), eb.load_scenario("cooperation-3-pair")


@pytest.fixture
def supersuit(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
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


@pytest.mark.parametrize(
    ("action", "steps", "ends"), [(1.0, 85, {(True, True)}), (-1.0, 160, {(True, False)})], ids=["drive on", "brake"]
)
def test_supersuit__tells_which_episodes_the_horizon_cut_off(
    action: float, steps: int, ends: set[tuple[bool, bool]], supersuit: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who drives on is never at rest; who brakes is before the horizon."""
    monkeypatch.setattr(supersuit, "COPIES", 4)
    worlds = supersuit.make_worlds(PAIR)
    worlds.seed(1)
    worlds.reset()
    told: set[tuple[bool, bool]] = set()
    for _ in range(steps):
        _, _, done, infos = worlds.step(np.full((worlds.num_envs, 1), action, np.float32))
        over = [info for d, info in zip(done, infos, strict=True) if d]
        told |= {(True, info.get("TimeLimit.truncated", False)) for info in over}
        assert all(info["terminal_observation"].shape == (27,) for info in over)
    assert told >= ends and (action < 0.0 or told == ends)


@pytest.mark.long
def test_supersuit__learns_to_beat_full_braking(supersuit: ModuleType, tmp_path: Path) -> None:
    supersuit.train(PAIR, 200_000, 0, tmp_path / "run")
    assert harm_beside_full_braking(f"ppo@{tmp_path / 'run'}") < 0.9
