"""The scout: decisions are tried where a difference is expected, and on average the same is learned."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest
import torch

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput, Progress
from ethbrake_marl.learning.algorithms import Scout, choose_rows, draw_rows
from ethbrake_marl.learning.runs import resume, train
from ethbrake_marl.learning.training import load_recipe

SCENARIO = eb.load_scenario("paper-random")
TINY = load_recipe("modes").replace(
    start=None, observation=None, focus=0.75, n_envs=8, n_steps=4, counterfactuals=16, batch_size=8, total_steps=512,
    network={"policy": [8]}, evaluation={"every_updates": 4, "worlds": 10, "seed": 7}, checkpoint_every_updates=3,
    modes=load_recipe("modes").model_dump(mode="json")["modes"] | {
        "gate": [4], "worlds": 64, "templates": 20, "gain": 0.0, "margin": 5.0, "imitation_epochs": 2,
        "gate_states": 32, "gate_memory": 100, "gate_steps": 4,
        "shares": {"alone": 0.25, "further": 0.25, "gate": 0.25, "together": 0.25},
    },
)  # fmt: skip


def test_drawn__mean_with_their_importance_is_the_mean_of_all() -> None:
    """One row in ten is worth 5, the others nothing: half a million draws know the mean, 0.5, to a hundredth."""
    torch.manual_seed(0)
    value = np.where(np.arange(1000) < 100, 5.0, 0.0)
    expected = np.where(value > 0.0, 1.0, 1e-3)
    rows, importance = draw_rows(expected, 500_000, 0.75)
    assert np.mean(value[rows] * importance) == pytest.approx(value.mean(), rel=1e-2)
    assert importance.mean() == pytest.approx(1.0, rel=1e-2)
    assert np.mean(rows < 100) == pytest.approx(0.75 * 100 / 100.9 + 0.25 * 0.1, abs=5e-3)
    assert importance.max() <= 4.0  # 1 / (1 - focus)


def test_chosen__without_focus_each_row_once() -> None:
    torch.manual_seed(0)
    observed, rows = np.zeros((50, 3), np.float32), np.arange(10, 30)
    chosen, importance = choose_rows(observed, rows, 15, 0.0, lambda seen: pytest.fail("nobody is asked"))
    assert len(set(chosen.tolist())) == 15 and set(chosen.tolist()) <= set(range(10, 30))
    assert (importance == 1.0).all()
    assert len(choose_rows(observed, rows[:0], 15, 0.5, lambda seen: np.ones(len(seen)))[0]) == 0
    assert len(choose_rows(observed, rows, 40, 0.5, lambda seen: np.ones(len(seen)))[0]) == 40


def test_scout__learns_the_mean_size_of_what_is_to_be_expected() -> None:
    """Half of the decisions are worth 3 on average (0 or 6), the others nothing."""
    torch.manual_seed(0)
    scout = Scout(2)
    kind = torch.arange(400) % 2
    seen, size = torch.nn.functional.one_hot(kind, 2).float(), kind * 6.0 * (torch.arange(400) % 4 == 1)
    optimizer = torch.optim.Adam(scout.parameters(), lr=1e-2)
    for _ in range(400):
        optimizer.zero_grad()
        scout.loss(seen, size, torch.ones(400)).backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    expected = scout.expect(np.eye(2, dtype=np.float32))
    assert expected[1] == pytest.approx(3.0, rel=0.05) and expected[0] < 0.05


@pytest.mark.slow
def test_training__with_a_scout_resumes_bit_for_bit(tmp_path: Path) -> None:
    whole = train(TINY, SCENARIO, tmp_path / "whole")

    def ctrl_c(progress: Progress) -> None:
        if progress.updates == 10:
            signal.raise_signal(signal.SIGINT)

    assert train(TINY, SCENARIO, tmp_path / "run", on_progress=ctrl_c).status == "interrupted"
    result = resume(tmp_path / "run")
    assert (result.status, result.evaluations) == ("finished", whole.evaluations)
    kept = [(tmp_path / run / "policy-last" / "weights.safetensors").read_bytes() for run in ("run", "whole")]
    assert kept[0] == kept[1]
    assert not any("scout" in name for name in result.policy.tensors)


def test_recipe__says_focus_only_where_there_is_one() -> None:
    assert "focus" not in load_recipe("modes").model_dump(mode="json")
    assert TINY.model_dump(mode="json")["focus"] == 0.75
    with pytest.raises(InvalidInput, match="focus"):
        TINY.replace(focus=1.0)
