"""The study of the paper's own process: plans, measures of learning curves by hand, and what decides a verdict."""

import json
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.reproduction.verdicts import Less
from ethbrake_marl.files.sheet import Estimate
from tests.docs.site import load

process = load("../studies/paper/process")


def course(*returns, harm: float = 1.0):
    values = np.array(returns, float)
    return process.Course(np.arange(1.0, values.shape[1] + 1.0) * 500.0, values, np.full(len(values), harm))


def test_course__by_hand() -> None:
    two = course([-10.0, -4.0, -2.0, 0.0], [-10.0, -6.0, -4.0, -2.0])
    assert two.last.tolist() == [-1.0, -3.0] and two.rise.tolist() == [9.0, 7.0]  # at least two points
    assert two.until.tolist() == [2_000.0, 2_000.0]  # at -1.9 and -3.7
    assert two.unrest.tolist() == pytest.approx([2.0**0.5, 2.0**0.5]) and two.spread.tolist() == [1.0, 1.0]
    still, rested = course([0.0, 50.0, 90.0, 90.0, 96.0, 96.0]), course([0.0, 50.0, 90.0, 90.0, 91.5, 91.5])
    assert (still.improvement, rested.improvement) == (6.0, 1.5)
    assert not still.is_converged and rested.is_converged and not course([9.0, 5.0, 4.0, 3.0, 2.0, 1.0]).is_converged


def test_no_verdict__rests_on_one_seed_or_on_a_training_that_still_improves_or_on_our_choice() -> None:
    seeds = [0, 50, 90, 90, 91, 91], [0, 50, 90, 90, 91, 92]
    two, one, still = course(*seeds), course(seeds[0]), course(*([0, 50, 90, 90, 96, 96],) * 2)
    less = [Less("a", Estimate(-1.0, (-2.0, -0.5)))]

    def judged(of, **given):
        return process.judge_trained("x", {"PPO": of}, less, **given).results["ours"]

    assert judged(two).verdict == "agrees"
    assert judged(two, ours_decides=True).verdict == "undecided"
    assert judged(one).verdict == "undecided" and judged(one).text.endswith("; one seed")
    assert judged(still).verdict == "undecided" and judged(still).text.endswith("; not converged")
    assert judged(two).text.startswith("holds: a, -1.00 [-2.00, -0.50] (PPO: 2 seeds, 3,000 decisions, last third ")


def test_plans__are_of_the_papers_map_and_shipped_recipes() -> None:
    for group, plans in process.GROUPS.items():
        for plan in plans:
            content = plan.training(1).content()
            assert content["recipe"]["seed"] == 1
            assert (content["scenario"].get("physics") == "paper-map") == (group != process.STOPPED)
            assert plan.terminal == (0.0 if group == process.DENSE else None)
            assert plan.decisions == {"sac-paper": 200_000, "ppo": 100_000}.get(plan.recipe)
            assert plan.seeds >= (5 if group in (process.STOPPED, process.RANDOM) else 2)


def plant(run: Path, end: float, status: str = "finished") -> None:
    """A run with 500 decisions a row, whose harm falls to ``end`` and is in every other row."""
    run.mkdir(parents=True)
    (run / "run.json").write_text(json.dumps({"status": status}))
    rows = [f"{500 * k},{-9.0 + k},{'' if k % 2 else end + 4.0 - k}" for k in range(1, 9)]
    (run / "progress.csv").write_text("\n".join([f"steps,{process.RETURN},{process.COST}", *rows]))


def test_trainings__that_are_finished_count(tmp_path: Path) -> None:
    ppo, sac = process.GROUPS[process.LOW]
    first, second, _ = ppo.runs(tmp_path, process.LOW)
    plant(first, 5.0)
    plant(second, 6.0, "interrupted")
    for number, run in enumerate(sac.runs(tmp_path, process.LOW)):
        plant(run, 7.0 + number)
    trained = process.trained(tmp_path, process.LOW)
    assert trained == {"PPO": [first], "SAC": sac.runs(tmp_path, process.LOW)}
    low = {name: process.Course.of(runs) for name, runs in trained.items()}
    assert low["SAC"].harm.tolist() == [3.0, 4.0, 5.0] and low["SAC"].decisions.tolist() == [
        500.0 * k for k in range(1, 9)
    ]
    claims = {claim.name: claim.results["ours"] for claim in process.curve_claims(low, low)}
    assert len(claims) == 11 and {result.verdict for result in claims.values()} == {"undecided"}
    assert claims["learning-curves/steadier"].text.endswith("; not converged; one seed")
    assert [claim.name for claim in process.reward_claims(low["PPO"], low["SAC"])] == [
        "learning-curves/sparse", "learning-curves/terminal",
    ]  # fmt: skip


def test_shapes__are_told_for_each_seed() -> None:
    policies = (("PPO", "coast"), ("SAC", "full_brake"))
    found = process.trajectories.commands(process.trajectories.record_all(policies))
    assert found["accelerations/PPO accelerates"] == ("first command +0.00 m/s²", False)
    assert found["accelerations/SAC decelerates"][1] and eb.load_recipe("ppo-paper").name == "ppo-paper"
