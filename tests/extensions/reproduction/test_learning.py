"""Learning curves and trainings: measures by hand, planted runs, tiny trainings by the paper's process."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.reproduction import items, learning, trajectories
from ethbrake_marl.extensions.reproduction.learning import DENSE, HIGH, LOW, RANDOM, STOPPED, Course, TrainingPlan
from ethbrake_marl.extensions.reproduction.made import Made, ReproductionSettings
from ethbrake_marl.extensions.reproduction.tables import process_sheet
from ethbrake_marl.extensions.reproduction.trajectories import all_records
from ethbrake_marl.extensions.reproduction.verdicts import Claim, Less
from ethbrake_marl.files.sheet import Estimate
from tests.refused import refused

pytest.importorskip("torch")


def course(*returns) -> Course:
    values = [{100.0 * (k + 1) / len(each): float(value) for k, value in enumerate(each)} for each in returns]
    return Course(values, values)


def test_course__by_hand() -> None:
    two = course([-10.0, -4.0, -2.0, 0.0], [-10.0, -6.0, -4.0, -2.0])
    assert two.last.tolist() == [0.0, -2.0] and two.rise.tolist() == [10.0, 8.0]
    assert two.converged.tolist() == [100.0, 100.0]  # at -1 and -2.8
    assert two.unrest.tolist() == pytest.approx([2.0**0.5, 2.0**0.5])  # of the second half
    assert two.spread.tolist() == [1.0, 1.0]
    assert course(range(20)).last.tolist() == [18.5]  # the last tenth
    assert course([0.0, 5.0, 9.1, 9.0, 10.0]).converged.tolist() == [60.0]


def runs(*returns, apart: float = 0.001) -> Course:
    return course(*(np.array(returns) + apart * seed for seed in range(3)))


def verdicts_of(claims: list[Claim]) -> dict[str, str]:
    return {claim.name: claim.verdict for claim in claims}


def test_convergence__is_a_last_third_that_improves_by_2_percent_of_the_rise_at_most() -> None:
    still = course([0.0, 50.0, 90.0, 90.0, 96.0, 96.0])  # 6 of 96
    rested = course([0.0, 50.0, 90.0, 90.0, 91.5, 91.5])  # 1.5 of 91.5
    assert (still.improvement, rested.improvement) == (6.0, 1.5)
    assert not still.is_converged and rested.is_converged
    assert course([0.0, 50.0, 90.0, 90.0, 70.0, 70.0]).is_converged
    assert not course([5.0] * 6).is_converged and not course([9.0, 5.0, 4.0, 3.0, 2.0, 1.0]).is_converged
    three_runs = runs(0, 50, 90, 90, 96, 96, apart=0.0)._replace(decisions=2_000.0, seconds=31.4, planned_seeds=5)
    assert three_runs.length == "3 of 5 seeds, 2,000 decisions, 31 CPU-s, last third +6.00 of a rise of 96.0"


def test_no_verdict__rests_on_a_training_that_still_improves() -> None:
    still, rested = runs(0, 50, 90, 90, 96, 96), runs(0, 50, 90, 90, 91, 91)
    less = [Less("a", Estimate(-1.0, (-2.0, -0.5)))]
    assert learning.judge_trained("x", {"PPO": rested}, less).verdict == "agrees"
    claim = learning.judge_trained("x", {"PPO": rested, "SAC": still}, less)
    assert claim.verdict == "not converged"
    assert claim.ours == f"holds: a, -1.00 [-2.00, -0.50] (PPO: {rested.length}; SAC: {still.length})"


def test_no_verdict__rests_on_one_seed() -> None:
    one, less = course([0, 50, 90, 90, 91, 91]), [Less("a", Estimate(-1.0, None))]
    two = runs(0, 50, 90, 90, 91, 91)._replace(planned_seeds=5)
    assert learning.judge_trained("x", {"PPO": one}, less).verdict == "undecided"
    assert learning.judge_trained("x", {"PPO": one, "SAC": two}, less).verdict == "undecided"
    assert learning.judge_trained("x", {"PPO": two}, less).verdict == "agrees"
    assert learning.judge_trained("x", {"PPO": two}, less, choice_decides=True).verdict == "undecided"
    still = course([0, 50, 90, 90, 96, 96])
    assert learning.judge_trained("x", {"PPO": still}, less).verdict == "not converged"


def test_statements__by_planted_courses() -> None:
    high = {"SAC": runs(-90, -22, -21, -20, -19, -20, apart=0.002), "PPO": runs(-90, -40, -21, -21, -21, -21)}
    three = course([-90, -40, -10, -10, -10, -10.1], [-90, -40, -12, -12, -12, -12.1], [-90, -40, -14, -14, -14, -14.2])
    low = {"SAC": runs(-90, -10, -10, -8, -12, -8), "PPO": three}  # SAC is at nine tenths sooner, and restless

    at_high = learning.claims_at_high_delay
    assert verdicts_of(at_high(high)) == {"steady": "agrees", "alike": "undecided", "PPO suits": "agrees"}
    alike, far = ({claim.name: claim.ours for claim in at_high(courses)}["alike"] for courses in (
        high, {**high, "PPO": runs(-90, -40, -31, -31, -31, -31)})
    )  # fmt: skip
    assert alike.startswith("holds: difference minus") and far.startswith("does not hold: ")  # 1 of 69, 11 of 59
    assert verdicts_of(at_high({**high, "SAC": runs(-90, -20, -5, -50, -5, -50)}))["steady"] == "differs"
    assert verdicts_of(learning.claims_at_low_delay(high, low)) == {
        "PPO converges": "agrees", "SAC converges": "agrees", "faster": "undecided", "higher": "agrees",
        "safer": "differs", "steadier": "agrees", "varied": "undecided", "SAC suits": "undecided",
    }  # fmt: skip
    swapped = verdicts_of(learning.claims_at_low_delay(low, high))
    assert (swapped["higher"], swapped["safer"], swapped["faster"]) == ("differs", "agrees", "undecided")
    (faster,) = (claim for claim in learning.claims_at_low_delay(high, low) if claim.name == "faster")
    assert faster.ours.startswith("holds: SAC after 33 decisions, PPO after 50 decisions is at nine tenths")
    wide = {name: course([-90, 0, -9], [-90, 0, -2], [-90, 0, -9], [-90, 0, -2]) for name in low}
    assert verdicts_of(learning.claims_at_low_delay(high, wide))["varied"] == "agrees"
    assert verdicts_of(learning.claims_at_low_delay(wide, high))["varied"] == "differs"
    unrested = {**low, "PPO": runs(-90, -40, -30, -20, -10, -9)}
    of_one = verdicts_of(learning.claims_at_low_delay(high, unrested))
    assert of_one.pop("SAC converges") == "agrees" and {*of_one.values()} == {"not converged"}
    of_both = [name for name, verdict in verdicts_of(learning.claims_at_low_delay(unrested, low)).items()
               if verdict == "not converged"]  # fmt: skip
    assert of_both == ["PPO converges", "higher", "safer", "varied"]


def test_reward__with_and_without_its_terminal_part() -> None:
    calm = runs(-90, -10, -10, -10, -10, -10)._replace(harm=[{100.0: 2.0}, {100.0: 2.1}, {100.0: 1.9}])
    restless = runs(-90, -10, -10, -10, -14, -6)._replace(harm=[{100.0: 3.0}, {100.0: 3.1}, {100.0: 2.9}])
    assert learning.reward_claims(calm, {}) == []
    sparse, terminal = learning.reward_claims(restless, {"PPO": calm})
    assert (sparse.verdict, terminal.verdict) == ("agrees", "differs")
    assert sparse.ours.startswith(
        "holds: deviation in the last quarter 6.7 % with it, 0.0 % of the rise without (with: 3 of 1 seeds"
    )
    assert terminal.ours.startswith("does not hold: harm 3.00 with it, 2.00 without (with: ")
    one = calm._replace(returns=calm.returns[:1], harm=calm.harm[:1])
    assert {claim.verdict for claim in learning.reward_claims(restless, {"PPO": one})} == {"undecided"}


def plant(run: Path, end: float, status: str = "finished", skip: int = 0) -> None:
    """A run with 500 decisions a row whose harm falls to ``end``; rows have the return, but ``skip``; some the harm."""
    run.mkdir(parents=True)
    (run / "run.json").write_text(json.dumps({"status": status, "evaluations": [{"cpu_s": end}] * 6}))
    rows = [f"{500 * k},{'' if k == skip else -9.0 + k},{'' if k % 2 else end + 4.0 - k}" for k in range(1, 5)]
    (run / "progress.csv").write_text("\n".join([f"steps,{learning.RETURN},{learning.HARM}", *rows]))


def test_curves__have_the_columns_of_the_runs(tmp_path: Path) -> None:
    settings = ReproductionSettings(tmp_path)
    for delay in (HIGH, LOW):
        for number, plan in enumerate(learning.TRAINING_GROUPS[delay]):
            for seed, run in enumerate(learning.runs_of(tmp_path, delay, plan)):
                plant(run, 10.0 * number + seed)
    made = learning.reproduce_curves(HIGH, settings)
    assert [row[:2] for row in made.sheets[0].rows] == [("PPO", 3), ("SAC", 3)]
    assert [[cell.value for cell in row[3:]] for row in made.sheets[0].rows] == [[1.0, -5.0], [11.0, -5.0]]
    assert made.sheets[0].rows[1][2] == "3 of 3 seeds, 2,000 decisions, 11 CPU-s, last third +1.00 of a rise of 3.0"
    assert {claim.verdict for claim in made.claims} == {"not converged"}
    assert [claim.name for claim in made.claims] == ["steady", "alike", "PPO suits"]
    returns, harm = made.figures[0].figure.axes
    assert returns.lines[0].get_xdata().tolist() == [25.0, 50.0, 75.0, 100.0]
    assert harm.lines[1].get_ydata().tolist() == [13.0, 11.0] and harm.get_xlabel() == "Training progress (%)"


def test_trainings__that_are_finished_count(tmp_path: Path) -> None:
    settings, (ppo, sac) = ReproductionSettings(tmp_path), learning.TRAINING_GROUPS[LOW]
    assert learning.reproduce_curves(LOW, settings) == Made()
    first, second, _ = learning.runs_of(tmp_path, LOW, ppo)
    plant(first, 1.0)
    plant(second, 2.0, "interrupted")
    one, two, begun = learning.runs_of(tmp_path, LOW, sac)
    plant(one, 3.0)
    plant(two, 4.0, skip=1)
    plant(begun, 9.0, "running")
    assert learning.trained_runs(tmp_path, LOW) == {ppo: [first], sac: [one, two]}
    assert learning.seconds_left(tmp_path, [LOW]) == 2 * 280.0 + 300.0
    courses = learning.courses_of(settings, LOW)
    assert courses["PPO"].length.startswith("1 of 3 seeds, 2,000 decisions, 1 CPU-s")
    assert courses["SAC"].length.startswith("2 of 3 seeds, 2,000 decisions, 4 CPU-s")
    assert courses["SAC"].last_harm.tolist() == [3.0, 4.0] and [*courses["SAC"].returns[0]] == [50.0, 75.0, 100.0]
    plant(learning.runs_of(tmp_path, DENSE, *learning.TRAINING_GROUPS[DENSE])[0], 1.0)
    made = learning.reproduce_curves(LOW, settings)  # no claim that compares delays
    assert verdicts_of(made.claims) == {"sparse": "not converged", "terminal": "not converged"}
    assert [row[0] for row in made.sheets[0].rows] == ["PPO", "SAC"]


def test_trainings__of_another_plan_are_refused(tmp_path: Path) -> None:
    settings, (ppo, _) = ReproductionSettings(tmp_path), learning.TRAINING_GROUPS[HIGH]
    run = learning.runs_of(tmp_path, HIGH, ppo)[1]
    plant(run, 1.0)
    file, right = run / "config.json", learning.planned_training(ppo, 1)
    file.write_text(json.dumps(right.config()))
    learning.check_trainings(tmp_path)
    earlier = right.config() | {"versions": {"ethbrake-marl": "1.0.0"}}
    earlier["recipe"] |= {"title": "Another title"}
    file.write_text(json.dumps(earlier))
    learning.check_trainings(tmp_path)
    for other, message in (
        (learning.planned_training(ppo, 0), "has other values of seed than the plan, ppo-paper on paper-delay-high"),
        (learning.planned_training(learning.TRAINING_GROUPS[LOW][0], 1), "has other values of "),
    ):
        file.write_text(json.dumps(other.config()))
        with refused(f"{file}: {message}"):
            items.reproduce(settings, [], "a machine")
    for damaged in ({}, {"recipe": {}, "scenario": {}}, {"recipe": right.config()["recipe"], "scenario": 7}):
        file.write_text(json.dumps(damaged))
        with refused(f"{file}: does not describe a training ("):
            learning.check_trainings(tmp_path)


def test_plans__are_of_the_papers_map_and_shipped_recipes() -> None:
    for group, plans in learning.TRAINING_GROUPS.items():
        for plan in plans:
            recipe, _ = eb.load_recipe(plan.recipe), eb.load_scenario(plan.scenario)
            seeds = {STOPPED: 1, RANDOM: 5, DENSE: 2}.get(group, 3)
            assert (plan.seeds, plan.mapped, plan.terminal) == (
                seeds,
                group != STOPPED,
                0.0 if group == DENSE else None,
            )
            if group == STOPPED:
                assert plan.decisions < recipe.total_steps / 10
            else:
                assert plan.decisions == (200_000 if (group, plan.recipe) == (RANDOM, "sac-paper") else None)


TINY = {"n_steps": 16, "batch_size": 64, "n_epochs": 1, "total_steps": 1024, "network": {"policy": [8], "value": [8]},
        "evaluation": {"every_updates": 4, "worlds": 10, "seed": 7}}  # fmt: skip


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ReproductionSettings:
    load = eb.load_recipe
    monkeypatch.setattr(eb, "load_recipe", lambda name: load("ppo-paper").replace(name=name, **TINY))
    stopped, process = (
        TrainingPlan("paper-random", "ppo", 1, 6.0, 512, mapped=False),
        TrainingPlan("paper-random", "ppo-paper", 2, 200.0),
    )
    monkeypatch.setattr(learning, "TRAINING_GROUPS", {STOPPED: (stopped,), RANDOM: (process,)})
    return ReproductionSettings(tmp_path, full=True, episodes=20)


def test_trainings__stop_and_continue(tiny: ReproductionSettings) -> None:
    def stop(progress: eb.Progress) -> None:
        if progress.done:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        learning.train_groups(replace(tiny, tell=stop), [STOPPED])
    assert learning.trained_runs(tiny.folder, STOPPED) == {} and learning.seconds_left(tiny.folder, [STOPPED]) == 6.0
    assert learning.train_groups(tiny, [STOPPED]) and learning.seconds_left(tiny.folder, [STOPPED]) == 0.0
    agent = eb.make_agent(learning.unconverged_policy(tiny.folder), scenario="paper-random")
    assert agent.policy.manifest.steps == 512


@pytest.mark.filterwarnings("error")
def test_process__is_trained_once_in_the_papers_map_and_shown(
    tiny: ReproductionSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert process_sheet(tiny) == []
    assert learning.train_groups(tiny, [RANDOM])
    (seeds,) = learning.trained_runs(tiny.folder, RANDOM).values()
    assert learning.course_of(seeds, 2).seconds > 0.0 and len(seeds) == 2
    before = [(run / "run.json").stat().st_mtime_ns for run in seeds]
    assert learning.train_groups(tiny, [RANDOM]) and before == [(run / "run.json").stat().st_mtime_ns for run in seeds]
    mapped = eb.load_scenario("paper-random").replace(physics="paper-map")
    for run in seeds:
        assert '"physics": "paper-map"' in (run / "config.json").read_text("utf-8")
    specs = [f"policy@{run / 'policy'}" for run in seeds]
    assert learning.process(tiny) == learning.process(replace(tiny, full=False)) == {"PPO": specs}
    result = eb.evaluate(mapped, specs, episodes=20, harm_count="first")
    harm = [result[spec]["first_impact_harm"].mean() for spec in specs]
    assert harm[0] != harm[1]  # other seeds
    (row,) = (row for row in process_sheet(tiny)[0].rows if row[0] == "PPO")
    assert row[2].value == pytest.approx(np.mean(harm))
    assert [*all_records(tiny)] == ["as stated", "nearest reading"]  # there is no SAC beside PPO
    monkeypatch.setattr(trajectories, "SHIPPED_SPECS", {"PPO": "coast"})
    assert [*all_records(tiny)] == ["as stated", "nearest reading", "paper's process 1", "paper's process 2"]
    assert [*all_records(tiny)["paper's process 2"]] == [("PPO", 1), ("PPO", 2)]
