"""Worlds of a device have the bits of ``Game.step``: here on a processor, with the code that a GPU runs."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

import ethbrake_marl as eb
from ethbrake_marl.episode.state import State
from ethbrake_marl.extensions.cuda.device import enough_memory
from ethbrake_marl.extensions.cuda.worlds import Worlds
from tests.refused import refused

SIX = {
    "instant": "paper-random",
    "build-up": "realistic-mixed-buildup",
    "obstacle": "paper-random-obstacle",
    "learners": "cooperation-4-all",
    "five": "cooperation-4-five",
    "types": "realistic-mixed",
}

FOLLOWED = eb.load_scenario("paper-random").replace(
    roles={"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "idm"}, early_impacts="keep"
)


def bits(array: Any) -> Any:
    return np.ascontiguousarray(array).view(np.int64 if array.dtype == np.float64 else np.int32)


def same(one: Any, other: Any) -> bool:
    return one.shape == other.shape and one.dtype == other.dtype and np.array_equal(bits(one), bits(other))


def same_state(one: State, other: State) -> bool:
    return all(same(mine, yours) for mine, yours in zip(one[:5], other[:5], strict=True))


def whole_episodes(name: str, n: int, device: str = "cpu") -> int:
    """Drive n worlds with random actions in both ways; return the decisions. Everything must have the same bits."""
    scenario, game = eb.open_game(name)
    alert = scenario.sample(n, seed=11)
    worlds, state, random = Worlds(name, n, alert, device), game.reset(alert), np.random.default_rng(3)
    assert same(worlds.reset().cpu().numpy(), game.observe_alike(state, game.settings.learners))
    decisions = 0
    while not state.ended.all():
        decisions += int((~state.ended).sum())
        actions = random.random((n, len(game.settings.learners)), np.float32) * 2.0 - 1.0
        state, step = game.step(state, actions.astype(np.float64))
        stepped = worlds.step(torch.from_numpy(actions).to(worlds.device), renew=False)
        assert same(worlds.results.out.cpu().numpy(), step.out)
        assert same(stepped.reward.cpu().numpy(), step.reward[:, 0])
        assert same(stepped.observations.cpu().numpy(), game.observe_alike(state, game.settings.learners))
        assert same_state(worlds.state(), state)
    worlds.check()
    return decisions


@pytest.mark.slow
@pytest.mark.parametrize("name", SIX.values(), ids=SIX)
def test_episodes__have_the_same_bits(name: str) -> None:
    assert whole_episodes(name, 20_000) > 20_000


@pytest.mark.slow
def test_an_episode_that_ends__is_replaced_by_the_next_world_of_the_pool() -> None:
    scenario, game = eb.open_game("paper-random")
    pool = scenario.sample(5, seed=7)
    worlds, first = Worlds("paper-random", 2, pool, "cpu"), game.reset(pool)
    worlds.reset()
    state, where, following = first.take([0, 1]), [0, 1], [2, 3]
    brake = torch.full((2, 1), -1.0)
    for _ in range(300):
        state, step = game.step(state, -np.ones((2, 1)))
        stepped = worlds.step(brake)
        assert same(stepped.terminated.numpy().astype(float), step.terminated.astype(float))
        assert same(stepped.total_harm.numpy(), step.total_harm)
        for row in np.flatnonzero(state.ended):
            where[row], following[row] = following[row], (following[row] + 2) % 5
            state = state.put([row], first.take([where[row]]))
        assert same_state(worlds.state(), state)
        assert same(stepped.observations.numpy(), game.observe_alike(state, game.settings.learners))
    assert where != [0, 1] and worlds.reset() is worlds.results.observations
    assert same_state(worlds.state(), first.take([0, 1]))


@pytest.mark.slow
def test_worlds_of_a_seed__are_the_training_worlds() -> None:
    _, game = eb.open_game("paper-random")
    worlds = Worlds("paper-random", 3, 8, "cpu", seed=5)
    worlds.reset()
    assert same_state(worlds.state(), game.reset(game.draw(3, 5, 0)))


@pytest.mark.slow
def test_put__goes_on_with_any_episodes() -> None:
    worlds, other = Worlds("paper-random", 4, 16, "cpu"), Worlds("paper-random", 6, 16, "cpu", seed=3)
    worlds.reset()
    before = worlds.step(torch.zeros(4, 1)).observations.clone()
    seen = other.put(worlds.now, torch.tensor([3, 3, 0, 0, 1, 2]))
    assert same(seen.numpy(), before[[3, 3, 0, 0, 1, 2]].numpy())
    assert same_state(other.state(), worlds.state().take([3, 3, 0, 0, 1, 2]))
    actions = torch.rand(4, 1)
    after = worlds.step(actions)
    assert same(other.step(actions[[3, 3, 0, 0, 1, 2]]).reward.numpy(), after.reward[[3, 3, 0, 0, 1, 2]].numpy())


@pytest.mark.slow
def test_put__takes_own_episodes_in_another_order() -> None:
    worlds = Worlds("paper-random", 3, 8, "cpu")
    before = worlds.state()
    worlds.put(worlds.now, torch.tensor([2, 0, 1]))
    assert same_state(worlds.state(), before.take([2, 0, 1]))


@pytest.mark.slow
@pytest.mark.parametrize("rows", [torch.tensor([0, 1]), torch.zeros(4)])
def test_put__of_other_rows_is_refused(rows: torch.Tensor) -> None:
    worlds = Worlds("paper-random", 4, 8, "cpu")
    with refused(f"rows = {rows.dtype} of shape {tuple(rows.shape)}: must be int64 of shape (4,)"):
        worlds.put(worlds.now, rows)


@pytest.mark.slow
def test_put__of_longer_lines_is_refused_and_changes_nothing() -> None:
    worlds, other = Worlds("paper-random", 2, 8, "cpu"), Worlds("cooperation-4-five", 2, 8, "cpu")
    before = worlds.state()
    with refused("stored: has 6 bodies in each world; must have 4"):
        worlds.put(other.now, torch.tensor([0, 1]))
    assert same_state(worlds.state(), before)


@pytest.mark.slow
def test_device__with_a_number_is_that_of_the_tensors() -> None:
    assert Worlds("paper-random", 2, 8, "cpu:0").step(torch.zeros(2, 1)).reward.shape == (2,)


@pytest.mark.parametrize(
    "what, raised",
    [
        ("torch's own error", torch.OutOfMemoryError("CUDA out of memory.\nTried to allocate")),
        ("numpy's", MemoryError()),
        ("torch's of a processor", RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried")),
    ],
)
def test_too_little_memory__is_one_line(what: str, raised: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*given: Any, **more: Any) -> None:
        raise raised

    monkeypatch.setattr(torch, "zeros", full)
    right = "n = 3 worlds, and a pool of 8, on device 'cpu': need more memory than the device has; choose smaller"
    with refused(right):
        Worlds("paper-random", 3, 8, "cpu")


def test_another_error__is_not_taken_for_too_little_memory() -> None:
    with pytest.raises(RuntimeError, match="another"), enough_memory("n"):
        raise RuntimeError("another")


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 3])
def test_actions__in_any_layout_of_memory(n: int) -> None:
    worlds, other = (Worlds("paper-random", n, 8, "cpu") for _ in range(2))
    actions = torch.tensor([[-1.0], [0.5], [1.0]])[:n]
    turned = torch.complex(actions, -actions).conj().imag  # torch keeps the sign beside the numbers
    for given in (turned, turned.clone().requires_grad_(), turned.repeat(1, 2).t()[:1].t()):
        step, expected = worlds.step(given), other.step(actions)
        assert same(step.reward.numpy(), expected.reward.numpy()) and same_state(worlds.state(), other.state())


@pytest.mark.slow
def test_new_worlds__have_begun() -> None:
    worlds = Worlds("paper-random", 4, 8, "cpu")
    begun, seen = worlds.state(), worlds.observations.clone()
    assert same(worlds.reset().numpy(), seen.numpy()) and same_state(worlds.state(), begun)
    assert eb.cuda.Worlds is Worlds


@pytest.mark.slow
def test_actions__are_clipped_and_nothing_moves_without_a_number() -> None:
    worlds, clipped = (Worlds("paper-random", 3, 8, "cpu") for _ in range(2))
    worlds.reset(), clipped.reset()
    worlds.step(torch.tensor([[-7.0], [2.0], [0.5]]))
    clipped.step(torch.tensor([[-1.0], [1.0], [0.5]]))
    assert same_state(worlds.state(), clipped.state())
    worlds.check()
    before = worlds.state()
    stepped = worlds.step(torch.tensor([[0.0], [float("nan")], [0.0]]))
    after = worlds.state()
    assert same_state(after.take([1]), before.take([1])) and not same_state(after.take([0]), before.take([0]))
    assert stepped.reward[1] == 0.0 and not stepped.terminated[1]
    with refused("an action of row 1 is no number"):
        worlds.check()
    worlds.reset()
    worlds.check()


@pytest.mark.slow
def test_reward__has_the_weights_of_the_game() -> None:
    reward = {"harm": 0.5, "harm_count": "honest", "terminal": 3.0}
    scenario, game = eb.open_game("paper-random", reward=reward)
    alert = scenario.sample(50, seed=7)
    worlds, state = Worlds("paper-random", 50, alert, "cpu", reward=reward), game.reset(alert)
    worlds.reset()
    total = np.zeros(50)
    while not state.ended.all():
        state, step = game.step(state, -np.ones((50, 1)))
        total += step.reward[:, 0]
        assert same(worlds.step(torch.full((50, 1), -1.0), renew=False).reward.numpy(), step.reward[:, 0])
    assert (total == 3.0).any() and (total < 0.0).any()


@pytest.mark.parametrize(
    "changes, reason",
    [
        ({"device": "cuda"}, "device = 'cuda': "),
        ({"device": "tpu"}, "device = 'tpu': must be 'cuda', or 'cpu'"),
        ({"n": 0}, "n = 0"),
        ({"pool": 0}, "pool = 0"),
        ({"seed": -1}, "seed = -1"),
        ({"pool": ("realistic-pair", 3)}, "pool: has 3 worlds of 2 vehicles; must have"),
        ({"pool": ("paper-random", 0)}, "pool: has 0 worlds of 3 vehicles"),
        ({"reward": "paper-reward"}, "the reward has collision, risk, jerk"),
        ({"reward": {"harm": 1.0, "shaping": 1.0}}, "the reward has shaping"),
        ({"reward": {"harm": 1.0, "objective": "own"}}, "the reward has harm of single vehicles;"),
        ({"observation": ["own", "contact"]}, "the observation has contact."),
        ({"learners": []}, "no learner"),
        ({"scenario": "paper-random-map"}, "another physics run on a processor only"),
        ({"scenario": FOLLOWED}, "vehicle_3 is driven by 'idm'"),
    ],
)
def test_what_does_not_run__is_refused_by_name(changes: dict[str, Any], reason: str) -> None:
    given: dict[str, Any] = {"scenario": "paper-random", "n": 4, "pool": 8, "device": "cpu"} | changes
    if isinstance(given["pool"], tuple):
        name, worlds = given["pool"]
        given["pool"] = eb.load_scenario(name).sample(3, seed=7).take(slice(worlds))
    if given["device"] == "cuda" and torch.cuda.is_available():
        pytest.skip("there is a GPU")
    with refused(reason):
        Worlds(given.pop("scenario"), given.pop("n"), given.pop("pool"), given.pop("device"), **given)


@pytest.mark.slow
@pytest.mark.parametrize(
    "actions, reason",
    [
        (np.zeros((4, 1), np.float32), "must be a dense torch tensor"),
        (torch.zeros(4), "of shape (4, 1)"),
        (torch.zeros(4, 1, dtype=torch.float64), "must be a dense torch tensor, float32"),
        (torch.zeros(4, 1).to_sparse(), "must be a dense torch tensor"),
        (torch.zeros(4, 1, device="meta"), "are on the device meta"),
    ],
)
def test_bad_actions__are_refused(actions: Any, reason: str) -> None:
    worlds = Worlds("paper-random", 4, 8, "cpu")
    with refused(reason):
        worlds.step(actions)
