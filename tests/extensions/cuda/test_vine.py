"""Vine on a device: the processor's gradients, whole trainings on the CPU twin, and what is refused."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

import ethbrake_marl as eb
from ethbrake_marl.extensions.cuda.graphs import Graphed
from ethbrake_marl.extensions.cuda.vine import CudaVine
from ethbrake_marl.extensions.learners.recipes import VineRecipe
from ethbrake_marl.extensions.learners.vine import Branches
from ethbrake_marl.training.recipe import VARIANTS, load_recipe
from ethbrake_marl.training.train import resume, train
from tests.extensions.learners.tiny import PAIR, PAPER, VINE, new_model
from tests.refused import refused
from tests.training.tiny import dying_after, kept, killed


class Twin(CudaVine):
    """The same algorithm, on the processor."""

    def device_of(self, recipe: VineRecipe) -> str:
        return "cpu"


@pytest.fixture(autouse=True)
def _twin(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr("ethbrake_marl.extensions.cuda.vine.POOL", 500)
    VARIANTS.loaded["vine.twin"] = Twin
    yield
    del VARIANTS.loaded["vine.twin"]


NOTHING: Any = SimpleNamespace(update_locals=lambda given: None, on_step=lambda: True)  # a callback
SMALL = VINE.replace(n_envs=32, n_steps=6, tried=96, batch_size=32, holds=[1, 2, 4], gamma=0.98)


def both(recipe: Any, scenario: Any) -> tuple[Any, Any]:
    models = new_model(recipe, scenario), new_model(recipe.replace(device="twin"), scenario)
    models[0].ep_info_buffer, models[0].ep_success_buffer = [], []
    return models


@pytest.mark.slow
@pytest.mark.parametrize("scenario", [PAPER, PAIR])
def test_decisions_and_gradients__are_those_of_the_processor(scenario: Any) -> None:
    """Up to the rounding of actions, which are single precision here: the kink at an impact can move a few."""
    cpu, twin = both(SMALL, scenario)
    for _ in range(3):
        (visited,), here = cpu.collect(NOTHING), twin.collect(NOTHING)
        np.testing.assert_array_equal(visited.observations, here.numpy())
        assert cpu.num_timesteps == twin.num_timesteps
        torch.manual_seed(5)
        expected = cpu.try_out(visited)
        torch.manual_seed(5)
        tried = twin.measure(here)
        assert torch.equal(tried.seen, expected.seen) and torch.equal(tried.mean, expected.mean)
        assert len(tried.gradient) == 96 and tried.gradient.abs().max() > 1.0
        off = (tried.gradient - expected.gradient).abs() > 1e-4 * (1.0 + expected.gradient.abs())
        assert off.sum() <= 1
    assert {*cpu.logger.name_to_value} == {*twin.logger.name_to_value}


@pytest.mark.slow
@pytest.mark.parametrize("reward", [{"harm": 1.0}, {"harm": 0.3, "harm_count": "honest", "terminal": 0.5}])
@pytest.mark.parametrize("scenario", [PAPER, PAIR])
def test_returns__are_those_of_the_processor_to_the_last_bit(scenario: Any, reward: dict[str, Any]) -> None:
    """Every action is exact in single precision: the output of the network is its bias, moved by powers of 2."""
    cpu, twin = both(SMALL.replace(reward=reward), scenario)
    for model in (cpu, twin):
        torch.nn.init.zeros_(model.policy.learning[-1].weight)
        torch.nn.init.constant_(model.policy.learning[-1].bias, -0.5)
    for _ in range(3):
        (visited,), _ = cpu.collect(NOTHING), twin.collect(NOTHING)
        world, size = np.arange(192), np.tile([0.125, -0.25, 0.75, -0.75], 48)
        branches = Branches(world, world % visited.line.learners, size, np.tile([1, 2, 4], 64))
        gained, moved = cpu.play(visited.line.game, visited.states, branches)
        with torch.no_grad():
            here = twin.played(*(torch.from_numpy(column) for column in branches))
        twin.branches.check()
        np.testing.assert_array_equal(here.numpy(), [gained, moved])
    assert len(np.unique(gained)) > 20 and len(np.unique(moved)) > 8


@pytest.mark.slow
def test_update__moves_the_weights_as_on_the_processor() -> None:
    cpu, twin = both(SMALL, PAPER)
    for model in (cpu, twin):
        torch.manual_seed(5)
        model.improve(model.collect(NOTHING))
    for mine, other in zip(cpu.policy.parameters(), twin.policy.parameters(), strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-4, atol=1e-6)
    assert cpu.policy.optimizer.param_groups[0]["lr"] == twin.policy.optimizer.param_groups[0]["lr"]


@pytest.mark.slow
def test_branches__that_have_ended_gain_and_move_nothing() -> None:
    """In the last decision of an episode an action counts once, however long it was to be held."""
    _, twin = both(SMALL, PAPER)
    for _ in range(twin.worlds.longest - 1):
        twin.worlds.step(torch.zeros(32, 1), renew=False)
    running = np.flatnonzero(~twin.worlds.state().ended)
    for visited, now in zip(twin.visited, twin.worlds.now, strict=True):
        visited[..., :32] = now
    world = torch.from_numpy(np.resize(running, 192))
    size = torch.cat([torch.full((96,), 0.1, dtype=torch.float64), torch.full((96,), -0.1, dtype=torch.float64)])
    with torch.no_grad():
        _, moved = twin.play_here(world, torch.zeros_like(world), size, torch.full((192,), 4))
    assert len(running) and moved[:96].numpy() == pytest.approx(0.1, abs=1e-6)


def begin(run: Path, **settings: Any) -> Any:
    return train(
        SMALL.replace(total_steps=20 * 6 * 32), PAPER, run, **{"device": "twin", "on_progress": None, **settings}
    )


@pytest.mark.slow
def test_resume__after_a_kill_everything_is_the_same(tmp_path: Path) -> None:
    result = begin(tmp_path / "whole")
    assert result.policy.manifest.algorithm == "vine" and result.updates == 20
    killed(begin, tmp_path / "run", on_progress=dying_after(14))
    assert resume(tmp_path / "run", on_progress=None).status == "finished"
    assert kept(tmp_path / "run") == kept(tmp_path / "whole")
    drives = eb.evaluate(PAPER, result.agent, episodes=10, seed=7)[result.agent]["first_impact_harm"].mean()
    assert drives == pytest.approx(result.metrics["first_impact_harm"], abs=1e-3)


@pytest.mark.slow
def test_training__gets_better_from_scratch(tmp_path: Path) -> None:
    ample = load_recipe("quick-cuda").replace(
        n_envs=256, tried=256, batch_size=32, total_steps=40 * 8 * 256,
        network={"policy": [32], "initial_action": -0.5},
        evaluation={"every_updates": 1000, "worlds": 300, "seed": 7},
    )  # fmt: skip
    first, last = train(ample, PAPER, tmp_path / "run", device="twin", on_progress=None).evaluations
    assert last["honest_cost"] < 0.7 * first["honest_cost"]


class Waits(Exception):
    """An operation waits for the device, or has a size that depends on data."""


class NoWaiting(TorchDispatchMode):
    """Refuse operations that no CUDA graph can contain."""

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if any(name in str(function) for name in ("_local_scalar_dense", "nonzero", "masked_select", "is_nonzero")):
            raise Waits(function)
        return function(*args, **(kwargs or {}))


@pytest.mark.slow
def test_graphs__contain_nothing_that_waits_for_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    _, twin = both(SMALL, PAPER)
    seen = twin.collect(NOTHING)
    monkeypatch.setattr(twin.policy.optimizer, "step", lambda: None)  # Adam's own, which a GPU captures
    given = (torch.from_numpy(column) for column in twin.draw_branches(twin.lines[0], np.arange(len(seen))))
    with NoWaiting():
        with torch.no_grad():
            twin.played(*given)
        twin.descended(seen[:32], torch.zeros(32), torch.ones(32))
        with pytest.raises(Waits):
            bool(seen.any())


class FakeGraph:
    """Repeats what was recorded, as a CUDA graph does: on the same tensors."""

    def replay(self) -> None:
        self.own.result.copy_(self.own.function(*self.own.inputs))


def test_graphed__replays_with_new_arguments(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []

    def double(given: torch.Tensor) -> torch.Tensor:
        calls.append(given)
        return 2.0 * given

    graphed = Graphed(double, torch.device("cuda"))
    FakeGraph.own = graphed  # type: ignore[attr-defined]
    for name, fake in {
        "device": nullcontext, "stream": nullcontext, "CUDAGraph": FakeGraph,
        "graph": lambda graph, stream: nullcontext(), "Stream": lambda: Main, "current_stream": lambda: Main,
    }.items():  # fmt: skip
        monkeypatch.setattr(torch.cuda, name, fake)
    assert [graphed(torch.tensor(float(k))).item() for k in range(6)] == [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]
    assert calls[3] is calls[4] is calls[5] and calls[2] is not calls[3]


class Main:
    @staticmethod
    def wait_stream(other: Any) -> None: ...


def start(recipe: Any, scenario: Any = PAPER, device: str = "twin") -> Callable[[], object]:
    return lambda: train(recipe, scenario, "new", device=device, measure=None, on_progress=None)


REFUSED: dict[str, Callable[[], object]] = {
    "batch_size = 7: must divide tried = 16 there": start(VINE.replace(batch_size=7)),
    "which functions of Python compute; the groups own,": start(load_recipe("vine").replace(
        n_envs=8, n_steps=4, tried=16, batch_size=8)),
    "messages with content and another physics run on a processor only": start(
        VINE, PAPER.replace(v2x={"preset": "nominal", "persistence": "periodic"}, early_impacts="keep")),
    "recipe 'vine': device = 'gpu': the algorithm vine cannot train there; every algorithm trains on cpu, vine also on"
    " cuda": start(VINE, device="gpu"),
    "recipe 'ppo': device = 'cuda': the algorithm ppo cannot train there; every": start("ppo", device="cuda"),
}  # fmt: skip


@pytest.mark.parametrize("message", REFUSED)
def test_training__is_refused(message: str, empty_folder: Path) -> None:
    with refused(message):
        REFUSED[message]()
    assert not Path("new").exists()


def test_too_many_worlds__are_refused_in_one_line(empty_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*given: Any, **more: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory.\nTried to allocate")

    monkeypatch.setattr("ethbrake_marl.extensions.cuda.vine.Worlds", full)
    with refused("n_envs = 8, n_steps = 4, tried = 16: need more memory than the device has; choose smaller"):
        start(VINE)()


@pytest.mark.slow
def test_too_little_memory_in_a_training__is_one_line(empty_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*given: Any, **more: Any) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory.\nTried to allocate")

    monkeypatch.setattr("ethbrake_marl.extensions.cuda.vine.CudaVineModel.measure", full)
    with refused("on device 'twin': n_envs = 32, n_steps = 6, tried = 96: need more memory than the device has"):
        start(SMALL.replace(total_steps=32 * 6))()


@pytest.mark.slow
def test_start__gives_the_weights_of_the_named_policy_as_on_the_processor(tmp_path: Path) -> None:
    begin(tmp_path / "first")
    cpu, twin = both(SMALL.replace(start=f"vine@{tmp_path / 'first'}"), PAPER)
    other = new_model(SMALL)
    named = eb.load_policy(tmp_path / "first").tensors["policy.output.weight"]
    for model in (cpu, twin):
        assert np.array_equal(model.policy.average[-1].weight.detach(), named)
        assert np.array_equal(model.policy.learning[-1].weight.detach(), named)
    assert not np.array_equal(other.policy.average[-1].weight.detach(), named)


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without a GPU")
def test_gpu__that_is_missing_is_one_line(empty_folder: Path) -> None:
    with refused("device = 'cuda'"):
        start("quick-cuda", device="cuda")()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_gpu__trains_and_goes_on_with_the_same_bits(tmp_path: Path) -> None:
    recipe = SMALL.replace(device="cuda")
    train(recipe, PAPER, tmp_path / "whole", steps=20 * 6 * 32, on_progress=None)
    told: list[int] = []

    def stop(progress: Any) -> None:
        told.append(progress.updates)
        if progress.updates == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(recipe, PAPER, tmp_path / "run", steps=20 * 6 * 32, on_progress=stop)
    assert resume(tmp_path / "run", on_progress=None).status == "finished"
    assert kept(tmp_path / "run") == kept(tmp_path / "whole")
