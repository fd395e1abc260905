"""`train/ppo_gpu.py`: PPO whose environments are on the device, here on a processor."""

import runpy
import sys
from copy import deepcopy
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

import ethbrake_marl as eb
from ethbrake_marl.episode.counts import IMPACT_COUNTS
from ethbrake_marl.policies.bundle import load_drivers
from tests.docs.site import load
from tests.refused import refused

PROGRAM = Path(__file__).resolve().parents[3] / "train" / "ppo_gpu.py"
SMALL = {"device": "cpu", "n": 64, "rollout": 16, "minibatches": 8, "hidden": 16, "pool": 500, "worlds": 200}


@pytest.fixture
def program() -> ModuleType:
    return load("../../train/ppo_gpu")


@pytest.mark.slow
@pytest.mark.parametrize(("name", "learners"), [("paper-random", 1), ("cooperation-4-all", 3)])
def test_training__lowers_harm_and_saves_the_policy_that_it_has_evaluated(
    name: str, learners: int, program: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fast = {"steps": 24_000 * learners, "learning_rate": 1e-2, "mean": 0.0}
    settings = program.Settings(scenario=name, harm_count="first", **fast, **SMALL)
    best = program.train(settings, tmp_path)
    assert "honest cost" in capsys.readouterr().out
    drivers = load_drivers(tmp_path / "policy")
    (policy,) = {id(each): each for each in drivers.values()}.values()
    assert len(policy.manifest.learners) == learners and policy.manifest.steps >= settings.steps
    assert policy.manifest.reward["harm"] == 0.05 and policy.manifest.reward["harm_count"] == "first"
    agents = {"mine": f"policy@{tmp_path}", "coasting": "coast"}
    result = eb.evaluate(name, agents, episodes=200, seed=1007)
    for count, column in ((each.name, each.column) for each in IMPACT_COUNTS):
        harm = result["mine"][column].mean()
        np.testing.assert_allclose(harm, best[count], rtol=1e-3)
        assert harm < 0.5 * result["coasting"][column].mean()


@pytest.mark.slow
def test_the_best_policy__is_kept_when_training_makes_it_worse(
    program: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second evaluation is the best of three, so its weights are saved."""
    seen: list[Any] = []

    def evaluate(actor: Any, _: Any) -> dict[str, float]:
        seen.append(actor.log_std.detach().clone().numpy())
        return dict.fromkeys(("first", "total", "honest"), [3.0, 1.0, 2.0][len(seen) - 1])

    monkeypatch.setattr(program, "evaluate", evaluate)
    best = program.train(program.Settings(steps=2 * 64 * 16, every=1, **SMALL), tmp_path)
    assert len(seen) == 3 and best["first"] == 1.0
    tensors = eb.load_policy(tmp_path).tensors
    assert tensors["policy.log_std"] == seen[1] != seen[2]


def test_advantages__by_hand(program: ModuleType) -> None:
    """Three steps of two learners with one reward; gamma and lambda are 0.5.

    First learner, where the second step ends an episode: A_2 = 3 - 2 + 0.5 (4 + 0) = 3, A_1 = 2 - 1 = 1,
    A_0 = 1 - 3 + 0.5 (1 + 0.5 * 1) = -1.25. The second learner's critic returns 0: 3, 2, 1 + 0.5 * 0.5 * 2 = 1.5.
    """
    rewards, ended = torch.tensor([1.0, 2.0, 3.0])[:, None, None], torch.tensor([0.0, 1.0, 0.0])[:, None, None]
    values = torch.tensor([[3.0, 0.0], [1.0, 0.0], [2.0, 0.0], [4.0, 0.0]])[:, None]
    result = program.advantages(rewards, ended, values, 0.5, 0.5)
    assert result[:, 0].tolist() == [[-1.25, 1.5], [1.0, 2.0], [3.0, 3.0]]


@pytest.mark.slow
def test_a_rollout__goes_on_where_the_last_one_ended(program: ModuleType) -> None:
    short = eb.load_scenario("paper-random").replace(horizon_s=3.0)  # some episodes end there, others before
    worlds, twin = (eb.cuda.Worlds(short, 6, 12, "cpu") for _ in range(2))
    settings = program.Settings(rollout=40, minibatches=4)
    ppo, truncated = program.Ppo(worlds, settings), False
    ppo.seen[-1].copy_(worlds.reset())
    seen = [twin.reset().clone()]
    for _ in range(2):
        ppo.collect()
        for t, actions in enumerate(ppo.actions):
            assert torch.equal(ppo.seen[t], seen[-1])
            step = twin.step(actions)
            seen.append(step.observations.clone())
            assert torch.equal(ppo.rewards[t, :, 0], step.reward.float())
            assert torch.equal(ppo.ended[t, :, 0] == 1.0, step.terminated | step.truncated)
            truncated |= bool(step.truncated.any())
    assert truncated and not ppo.ended.all()
    values = ppo.critic(ppo.seen)[..., 0]
    gains = program.advantages(ppo.rewards, ppo.ended, values, settings.gamma, settings.gae_lambda)
    assert torch.allclose(ppo.targets, gains + values[:-1], atol=1e-5)
    assert torch.allclose(ppo.gains, (gains - gains.mean()) / gains.std(), atol=1e-5)
    mean, std = ppo.actor.mean(ppo.seen[:-1])[..., 0], ppo.actor.log_std.exp()
    exact = torch.distributions.Normal(mean, std).log_prob(ppo.actions) + 0.5 * np.log(2.0 * np.pi)
    assert torch.allclose(ppo.before, exact, atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("ratio", "gain", "learns"), [(1.5, 1.0, False), (1.5, -1.0, True), (0.5, -1.0, False)])
def test_the_actor__does_not_learn_beyond_the_clip(
    ratio: float, gain: float, learns: bool, program: ModuleType
) -> None:
    """If an action is already more (less) likely than 1.2 (0.8) times before, it is not made yet more (less) so."""
    ppo = program.Ppo(eb.cuda.Worlds("paper-random", 8, 16, "cpu"), program.Settings(n=8, rollout=8, minibatches=4))
    ppo.collect()
    ppo.before -= np.log(ratio)
    ppo.gains.fill_(gain)
    before = deepcopy(ppo.networks)
    ppo.update()
    changed = [
        any((one != other).any() for one, other in zip(mine.parameters(), old.parameters(), strict=True))
        for mine, old in zip(ppo.networks, before, strict=True)
    ]
    assert changed == [learns, True]


@pytest.mark.slow
def test_the_actor__learns_the_same_beside_a_critic_with_large_errors(program: ModuleType) -> None:
    actors = []
    for scale in (1.0, 1e6):
        torch.manual_seed(0)
        ppo = program.Ppo(eb.cuda.Worlds("paper-random", 8, 16, "cpu"), program.Settings(n=8, rollout=8, minibatches=4))
        ppo.collect()
        ppo.targets *= scale
        ppo.update()
        actors.append(ppo.actor)
    assert all(torch.equal(*each) for each in zip(*(each.parameters() for each in actors), strict=True))


@pytest.mark.slow
def test_training__begins_in_the_worlds_of_its_seed_near_full_braking_and_the_rate_falls_as_a_cosine(
    program: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen, rates = [], []

    def learn(ppo: Any, *_: Any) -> None:
        seen.append(ppo.seen[-1].clone())
        rates.append(ppo.rate.item())
        assert torch.allclose(ppo.actor.mean(seen[0]), torch.tensor(-0.9), atol=0.1)

    monkeypatch.setattr(program.Ppo, "learn", learn)
    program.train(program.Settings(seed=5, steps=4 * 64 * 16, learning_rate=1.0, **SMALL), tmp_path)
    assert torch.equal(seen[0], eb.cuda.Worlds("paper-random", 64, 500, "cpu", seed=5).reset())
    np.testing.assert_allclose(rates, [1.0, 0.5 + 0.5**1.5, 0.5, 0.5 - 0.5**1.5], rtol=1e-6)


@pytest.mark.slow
def test_actions_that_are_no_numbers__are_refused(program: ModuleType) -> None:
    worlds = eb.cuda.Worlds("paper-random", 8, 16, "cpu")
    ppo = program.Ppo(worlds, program.Settings(n=8, rollout=8, minibatches=4))
    torch.nn.init.constant_(ppo.actor.mean[-1].bias, float("nan"))
    with refused("an action of row 0 is no number"):
        ppo.learn()
    with refused("an action of row 0 is no number"):
        program.evaluate(ppo.actor, worlds)


class NoReading(TorchDispatchMode):
    """While it holds, nothing may read a tensor as a number, for which a GPU would have to be waited for."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        assert func not in (torch.ops.aten._local_scalar_dense.default, torch.ops.aten.nonzero.default)
        return func(*args, **(kwargs or {}))


@pytest.mark.slow
def test_rollout_and_update__can_be_recorded(program: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    """CUDA graphs demand that no number is read and that no tensor moves."""
    ppo = program.Ppo(eb.cuda.Worlds("paper-random", 8, 16, "cpu"), program.Settings(n=8, rollout=8, minibatches=4))
    ppo.collect(), ppo.update()

    def addresses() -> list[int]:
        results = (ppo.seen, ppo.stored, ppo.rewards, ppo.ended, ppo.rows, ppo.rate, *ppo.worlds.results)
        learned = [tensor for each in ppo.networks.parameters() for tensor in (each, each.grad)]
        moments = [tensor for state in ppo.optimiser.state.values() for tensor in state.values()]
        return [each.data_ptr() for each in (*results, *ppo.worlds.now, ppo.worlds.following, *learned, *moments)]

    before = addresses()
    ppo.collect(), ppo.update()
    assert addresses() == before
    monkeypatch.setattr(ppo.optimiser, "step", lambda: None)  # on a processor it reads the learning rate
    with NoReading():
        ppo.collect(), ppo.update()
    with pytest.raises(AssertionError), NoReading():
        ppo.rate.item()


@pytest.mark.slow
def test_the_learning_rate__is_the_tensor_that_the_optimiser_reads(program: ModuleType) -> None:
    ppo = program.Ppo(eb.cuda.Worlds("paper-random", 8, 16, "cpu"), program.Settings(n=8, rollout=8, minibatches=4))
    before = ppo.actor.log_std.item()
    ppo.rate.fill_(0.0)
    ppo.learn()
    assert ppo.actor.log_std.item() == before
    ppo.rate.fill_(0.1)
    ppo.learn()
    assert ppo.actor.log_std.item() != before


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--device", "cuda"], "device = 'cuda': "),
        (["--device", "cpu", "--scenario", "paper-randon"], "did you mean 'paper-random'?"),
        (
            ["--device", "cpu", "--scenario", "paper-random-map", "--harm-count", "first"],
            "another physics run on a processor only",
        ),
        (["--device", "cpu", "--scenario", "level-0-sensors"], "has no learner"),
        (["--device", "cpu", "--harm-count", "last"], "harm_count"),
        (["--steps", "0"], "steps = 0"),
        (["--n", "2", "--rollout", "4"], "minibatches = 16: must be at most n * rollout = 8"),
        (["--output", "there"], "there: already exists"),
    ],
)
def test_program__refuses_what_cannot_be_before_it_trains(
    arguments: list[str],
    message: str,
    empty_folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    if arguments == ["--device", "cuda"] and torch.cuda.is_available():
        pytest.skip("there is a GPU")
    Path("there").mkdir()
    monkeypatch.setattr(sys, "argv", ["ppo_gpu.py", "--output", "mine", *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(PROGRAM), run_name="__main__")
    printed = capsys.readouterr().err
    assert ended.value.code == 2 and message in printed and printed.count("\n") == 1
    assert list(empty_folder.rglob("*")) == [empty_folder / "there"]


def test_program__says_in_one_line_that_memory_is_too_little(
    empty_folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*given: Any, **more: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory.\nTried to allocate")

    monkeypatch.setattr(eb.cuda.Worlds, "stored", full)
    monkeypatch.setattr(sys, "argv", ["ppo_gpu.py", "--output", "mine", "--device", "cpu", "--pool", "50"])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(PROGRAM), run_name="__main__")
    printed = capsys.readouterr().err
    right = "error: n = 1024, pool = 50, rollout = 32: need more memory than the device has; choose smaller numbers\n"
    assert ended.value.code == 2 and printed.endswith(right) and not [*empty_folder.iterdir()]
