"""The scripts below train/: IPPO and MAPPO in one file each, SuperSuit with PPO, and a clone of a dataset."""

import runpy
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.policies.bundle import load_policy
from ethbrake_marl.training.own_team import save_team
from ethbrake_marl.training.team import load_team
from tests.docs.site import load
from tests.learning.tiny import harm_beside_full_braking

pytestmark = pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning", "ignore::FutureWarning")
TRAIN = Path(__file__).resolve().parents[2] / "train"
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


@SINGLE_FILES
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scenario", "cooperation-3-pear"], "did you mean 'cooperation-3-pair'?"),
        (["--steps", "0"], "steps = 0: must be a whole number, at least 1"),
        (["--copies", "0"], "copies = 0: must be a whole number, at least 1"),
        (["--minibatch", "0"], "minibatch = 0: must be a whole number, at least 1"),
        (["--seed", "-1"], "seed"),
        (["--output", "there"], "there: already exists"),
        (["--harm-count", "all"], "harm_count"),
        (["--scenario", "cooperation-0-sensors"], "has no learner"),
    ],
)
def test_single_file__refuses_what_cannot_be_before_it_trains(
    arguments: list[str],
    message: str,
    script: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").mkdir()
    monkeypatch.setattr(sys, "argv", [f"{script}.py", "--output", "new", *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(TRAIN / f"{script}.py"), run_name="__main__")
    said = capsys.readouterr()
    assert ended.value.code == 2 and message in said.err and said.out == "" and not (tmp_path / "new").exists()


@SINGLE_FILES
def test_single_file__ends_with_the_command_that_evaluates(
    script: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    few = [part for name, value in FEW.items() for part in (f"--{name}", str(value))]
    # minibatches of 32 leave a last one of one row
    odd = ["--copies", "5", "--rollout", "13", "--minibatch", "32"]
    monkeypatch.setattr(sys, "argv", [f"{script}.py", "--output", "my team", *few, *odd])
    runpy.run_path(str(TRAIN / f"{script}.py"), run_name="__main__")
    last = capsys.readouterr().out.splitlines()[-1]
    assert last == "ethbrake evaluate --scenario cooperation-3-pair --agents 'full_brake,e_v2x_bm,team@my team'"
    assert (tmp_path / "my team" / "team.json").is_file()
    eb.make_agent("ppo@my team", scenario=PAIR)


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


def test_save_team__refuses_layers_that_a_bundle_cannot_hold(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="must be linear layers with ReLU between them, or with Tanh between them"):
        save_team(tmp_path / "a", {"vehicle_2": OwnActor(torch.nn.GELU())}, eb.parallel_env(), seed=0, steps=1)
    assert not (tmp_path / "a").exists()
