"""The programs in train/: IPPO and MAPPO in one file each, a GRU, SuperSuit with PPO; and teams of one's own."""

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.policies.bundle import load_drivers, load_policy
from ethbrake_marl.training.own_team import save_team
from tests.docs.site import load

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
    names = [f"vehicle_{body}" for body in line.learners]
    for vehicle in names:
        place = "policy" if len(names) == 1 else f"policy/{vehicle}"
        one, again, other = (load_policy(tmp_path / folder / place) for folder in ("one", "again", "other"))
        assert one.manifest == again.manifest and one.manifest.weights_sha256 != other.manifest.weights_sha256
        assert one.manifest.learners == (vehicle,) and one.manifest.reward["harm"] == 0.05
    result = eb.evaluate(line, {"braking": "full_brake", "mine": f"team@{tmp_path / 'one'}"}, episodes=20)
    assert (result["mine"]["first_impact_harm"] != result["braking"]["first_impact_harm"]).any()


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
    result = eb.evaluate(PAIR, {"braking": "full_brake", "mine": f"team@{tmp_path}"}, episodes=1000)
    braking, mine = (result[name]["first_impact_harm"].mean() for name in ("braking", "mine"))
    assert mine < 0.6 * braking


class OwnActor:
    """One hidden layer, whose mean is often out of [-1, 1]."""

    def __init__(self, between: torch.nn.Module) -> None:
        features = len(eb.View().names)
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
    if not shared:
        assert sorted(load_drivers(tmp_path / "policy")) == ["vehicle_2", "vehicle_3"]
    result = eb.evaluate(
        PAIR, {"saved": f"team@{tmp_path}", "mine": {n: agent_of(a) for n, a in actors.items()}}, episodes=5
    )
    np.testing.assert_allclose(result["saved"]["total_harm"], result["mine"]["total_harm"], rtol=1e-4)


def agent_of(actor: OwnActor) -> eb.Agent:
    return eb.policy_agent(actor.mean, clip=True)


@pytest.mark.parametrize(
    ("actors", "message"),
    [
        (
            {"vehicle_2": torch.nn.Linear(27, 1)},
            r"actor of vehicle_2, a Linear, must have the attributes mean, .*policy_agent\(network\)",
        ),
        (
            {"vehicle_2": OwnActor(torch.nn.Sigmoid())},
            "must have the attributes mean, an nn.Sequential of linear layers with ReLU",
        ),
        (
            {"vehicle_3": OwnActor(torch.nn.ReLU())},
            "actors of vehicle_3; must have one of each learner of the environment, vehicle_2",
        ),
        ({}, "actors of nobody; must have one of each learner"),
    ],
)
def test_save_team__names_what_an_actor_must_be(actors: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=message):
        save_team(tmp_path, actors, eb.parallel_env("paper-random"), seed=0, steps=0)
