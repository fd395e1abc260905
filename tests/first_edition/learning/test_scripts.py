"""The scripts below train/: IPPO and MAPPO in one file each, SuperSuit with PPO, and a clone of a dataset."""

import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.policies.bundle import load_policy
from ethbrake_marl.first_edition.training.own_team import save_team
from ethbrake_marl.first_edition.training.team import load_team
from tests.docs.site import load
from tests.first_edition.learning.tiny import harm_beside_full_braking

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning", "ignore::FutureWarning")
PAIR = eb.load_scenario("cooperation-3-pair")


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


SINGLE_FILES = pytest.mark.parametrize("script", ["ippo", "mappo"])
FEW = {"steps": 600, "copies": 4, "rollout": 60, "minibatch": 64, "hidden": 8}


@SINGLE_FILES
@pytest.mark.parametrize("name", ["cooperation-3-pair", "cooperation-4-all", "cooperation-2-paper"])
def test_single_file__leaves_a_team_that_evaluates_and_is_the_same_twice(
    name: str, script: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    module, line = load(f"../../train/{script}"), eb.load_scenario(name)
    for folder, seed in (("one", 1), ("again", 1), ("other", 2)):
        module.train(module.Settings(scenario=name, seed=seed, **FEW), tmp_path / folder)
    assert "decisions: mean harm of an episode" in capsys.readouterr().out
    teams = [load_team(tmp_path / folder, line) for folder in ("one", "again", "other")]
    assert sorted(teams[0].drivers) == list(line.learners)
    for vehicle in line.learners:
        one, again, other = (team.drivers[vehicle].policy for team in teams)
        assert one.manifest == again.manifest and one.manifest.weights_sha256 != other.manifest.weights_sha256
        assert one.manifest.learners == (line.vehicle_names[vehicle],) and one.manifest.reward["harm"] == 0.05
    agents = {each: eb.make_agent(each, scenario=line) for each in ("full_brake", f"team@{tmp_path / 'one'}")}
    found = eb.evaluate(line.sample(20, 7), agents, scenario=line)
    assert all(np.isfinite(found.outcome(each).first_impact_harm).all() for each in agents)


@SINGLE_FILES
def test_single_file__advantages_by_hand(script: str) -> None:
    """Two steps, the first of which ends an episode: A_1 = 2 - 1 + 0.5 (4 + 0) = 3; A_0 = 1 - 3 = -2."""
    module = load(f"../../train/{script}")
    settings = module.Settings(rollout=2, copies=1, gamma=0.5, gae_lambda=0.5)
    rewards, ended = torch.tensor([[1.0], [2.0]]), torch.tensor([[1.0], [0.0]])
    values = torch.tensor([[3.0], [1.0], [4.0]])
    if script == "ippo":
        rollout = module.Rollout(1, settings)
        rollout.rewards, rollout.ended = rewards, ended
    else:
        rewards, ended, values = rewards[..., None], ended[..., None], values[..., None]
        rollout = module.Rollout({}, torch.empty(0), torch.empty(0), rewards, ended)
    assert module.advantages(rollout, values, settings).flatten().tolist() == [-2.0, 3.0]
    ended[0] = 0.0  # now the second step counts for the first: -2 + 0.5 (1 + 0.5 * 3) = -0.75
    assert module.advantages(rollout, values, settings).flatten().tolist() == [-0.75, 3.0]


@pytest.mark.long
@SINGLE_FILES
def test_single_file__learns_to_beat_full_braking(script: str, tmp_path: Path) -> None:
    module = load(f"../../train/{script}")
    module.train(module.Settings(steps=500_000), tmp_path)
    assert harm_beside_full_braking(f"team@{tmp_path}") < 0.6


class OwnActor:
    """One hidden layer, whose mean is often out of [-1, 1]."""

    def __init__(self, between: torch.nn.Module) -> None:
        features = eb.observation_for(PAIR).size
        self.mean = torch.nn.Sequential(torch.nn.Linear(features, 4), between, torch.nn.Linear(4, 1))
        torch.nn.init.normal_(self.mean[-1].weight, std=30.0)
        self.log_std = torch.nn.Parameter(torch.full((1,), -0.5))


@pytest.mark.parametrize("between", [torch.nn.ReLU(), torch.nn.Tanh()])
@pytest.mark.parametrize("shared", [True, False])
def test_save_team__acts_as_the_actors_do(between: torch.nn.Module, shared: bool, tmp_path: Path) -> None:
    torch.manual_seed(0)
    front, rear = OwnActor(between), OwnActor(between)
    actors = {"vehicle_2": front, "vehicle_3": front if shared else rear}
    save_team(tmp_path, actors, eb.parallel_env(PAIR), seed=3, steps=5)
    seen = eb.make_sb3_vec_env(PAIR, 50, seed=1).reset() * 5.0
    for name, actor in actors.items():
        policy = load_policy(tmp_path / ("policy" if shared else f"policy/{name}"))
        theirs = actor.mean(torch.from_numpy(seen)).clamp(-1.0, 1.0).detach().numpy()
        np.testing.assert_allclose(policy(seen), theirs, atol=1e-5)
        assert np.abs(theirs).max() == 1.0 and policy.tensors["policy.log_std"] == np.float32(-0.5)
        assert policy.manifest.learners == (tuple(actors) if shared else (name,))
        assert (policy.manifest.seeds, policy.manifest.steps) == ({"training": 3}, 5)
    assert sorted(load_team(tmp_path, PAIR).drivers) == [1, 2]
