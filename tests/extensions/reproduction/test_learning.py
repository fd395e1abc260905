"""Learning curves and trainings: measures by hand, tiny trainings."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.reproduction import learning
from ethbrake_marl.extensions.reproduction.learning import HIGH, LOW, STOPPED, Course, Plan, judge, reproduce_curves
from ethbrake_marl.extensions.reproduction.made import Settings
from tests.fixtures.commands import TINY_RECIPE

pytest.importorskip("torch")


def course(*returns) -> Course:
    values = [dict(enumerate(map(float, each))) for each in returns]
    return Course(values, values)


def test_course__by_hand() -> None:
    one = course([-9.0, -4.0, -2.0, 0.0], [-9.0, -6.0, -4.0, -2.0])
    assert one.last_returns.tolist() == [0.0, -2.0]
    assert one.spread.tolist() == pytest.approx([2.0**0.5, 2.0**0.5])  # of the second half
    assert course(range(20)).last_returns.tolist() == [18.5]  # the last tenth


def test_verdicts__compare_the_papers_two_recipes_at_both_delays() -> None:
    high = {"ppo-paper": course([-9.0] * 4, [-9.1] * 4), "sac-paper": course([-8.0] * 4, [-8.1] * 4)}
    low = {"ppo-paper": course([-1.0] * 4, [-1.01] * 4), "sac-paper": course([-2.0] * 4, [-2.5] * 4)}
    higher, spread, others = judge(high, low)
    assert higher.outcome == "agrees" and "holds in 2 of 2" in higher.because
    assert spread.outcome == "differs" and "holds in 1 of 2; not so: ppo-paper, 0.064" in spread.because
    assert others.outcome == "not run"
    assert judge(low, high)[0].outcome == "differs"
    assert {each.outcome for each in judge(high, {"ppo-paper": low["ppo-paper"]})} == {"not run"}


def test_plans__are_of_shipped_recipes_and_scenarios() -> None:
    for plans in learning.GROUPS.values():
        for plan in plans:
            recipe, _ = eb.load_recipe(plan.recipe), eb.load_scenario(plan.scenario)
            assert plan.decisions < recipe.total_steps and plan.seeds in (1, 3)


def test_trainings__are_done_once_continue_and_give_curves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    load = eb.load_recipe
    monkeypatch.setattr(eb, "load_recipe", lambda name: load({**TINY_RECIPE, "n_steps": 128, "name": name}))
    plans = {group: (Plan("paper-delay-high", "ppo-paper", 2048, 1, 2, 128),) for group in (HIGH, LOW)}
    monkeypatch.setattr(learning, "GROUPS", {STOPPED: (Plan("paper-random", "ppo", 2048, 1, 1, 16),), **plans})
    tiny = Settings(tmp_path, full=True, episodes=5)
    assert learning.seconds_left(tiny.folder, [HIGH, LOW]) == 4 * 16.0

    def stop(progress: eb.Progress) -> None:
        if progress.done:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        learning.train(replace(tiny, tell=stop), [STOPPED])
    assert learning.trained(tiny.folder, STOPPED) == {}
    assert learning.train(tiny, [STOPPED, HIGH])
    agent = eb.make_agent(learning.unconverged(tiny.folder), scenario="paper-random")
    assert agent.policy.manifest.steps == 2048
    runs = learning.trained(tiny.folder, HIGH)["ppo-paper"]
    before = [(run / "run.json").stat().st_mtime_ns for run in runs]
    assert learning.seconds_left(tiny.folder, [HIGH, LOW]) == 2 * 16.0
    assert learning.train(tiny, [HIGH]) and before == [(run / "run.json").stat().st_mtime_ns for run in runs]
    made = reproduce_curves(HIGH, tiny)
    assert [drawn.stem for drawn in made.figures] == ["learning-high-paper"]
    name, seeds, decisions, kept, last, _ = made.sheets[0].rows[0]
    assert (name, seeds, decisions) == ("ppo-paper", 2, "2,048")
    final = [learning.column(run, learning.HARM)[2048] for run in runs]
    assert last.value == pytest.approx(np.mean(final)) and kept.value <= last.value
    assert final[0] != final[1]  # other seeds
    (runs[1] / "run.json").write_text('{"status": "interrupted"}')
    assert learning.trained(tiny.folder, HIGH) == {}  # one seed of two is not finished
    nothing = reproduce_curves(HIGH, replace(tiny, full=False))
    assert nothing.verdict.outcome == "not run" and not nothing.figures
