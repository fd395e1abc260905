"""Learning curves and trainings: measures by hand, a tiny training that is interrupted and goes on."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.extensions.report.seed_curves import SeedCurve
from ethbrake_marl.extensions.reproduction import learning, trainings
from ethbrake_marl.extensions.reproduction.learning import HIGH, LOW, Course, judge, reproduce_curves
from ethbrake_marl.extensions.reproduction.made import Settings
from ethbrake_marl.extensions.reproduction.trainings import GROUPS, STOPPED, Plan
from ethbrake_marl.training import recipe as recipe_module
from ethbrake_marl.training.recipe import load_recipe
from tests.fixtures.commands import TINY_RECIPE
from tests.refused import refused

pytest.importorskip("torch")
eb.train  # noqa: B018  # its modules keep the shipped recipes


def course(returns, harm=((1.0,),)) -> Course:
    return Course(*(SeedCurve(np.arange(len(each[0]), dtype=float), np.array(each)) for each in (returns, harm)))


def test_course__by_hand() -> None:
    one = course([[-9.0, -4.0, -2.0, 0.0], [-9.0, -6.0, -4.0, -2.0]])
    assert one.last_returns.tolist() == [0.0, -2.0]
    assert one.spread.tolist() == pytest.approx([2.0**0.5, 2.0**0.5])  # of the second half
    assert course([[*range(20)]]).last_returns.tolist() == [18.5]  # the last tenth


def test_verdicts__compare_the_papers_two_recipes_at_both_delays() -> None:
    high = {"ppo-paper": course([[-9.0] * 4, [-9.1] * 4]), "sac-paper": course([[-8.0] * 4, [-8.1] * 4])}
    low = {"ppo-paper": course([[-1.0] * 4, [-1.01] * 4]), "sac-paper": course([[-2.0] * 4, [-2.5] * 4])}
    higher, spread, others = judge(high, low)
    assert higher.outcome == "agrees" and "holds in 2 of 2" in higher.because
    assert spread.outcome == "differs" and "holds in 1 of 2; not so: ppo-paper, 0.064" in spread.because
    assert others.outcome == "not run"
    assert judge(low, high)[0].outcome == "differs"
    assert {each.outcome for each in judge(high, {"ppo-paper": low["ppo-paper"]})} == {"not run"}


def test_plans__are_of_shipped_recipes_and_scenarios() -> None:
    for plans in GROUPS.values():
        for plan in plans:
            recipe, _ = eb.load_recipe(plan.recipe), eb.load_scenario(plan.scenario)
            assert plan.decisions < recipe.total_steps and plan.seeds in (1, 3)


@pytest.fixture
def tiny(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Settings:
    """A plan in each group."""
    monkeypatch.setattr(
        recipe_module, "load_recipe", lambda name: load_recipe({**TINY_RECIPE, "n_steps": 128, "name": name})
    )
    plans = {group: (Plan("paper-delay-high", "ppo-paper", 4096, 1, 2, 256),) for group in (HIGH, LOW)}
    monkeypatch.setattr(trainings, "GROUPS", {STOPPED: (Plan("paper-random", "ppo", 256, 1, 1, 16),), **plans})
    return Settings(tmp_path, full=True, episodes=5)


def test_trainings__are_done_once_and_give_curves(tiny: Settings) -> None:
    assert trainings.seconds_left(tiny.folder, [HIGH, LOW]) == 4 * 16.0
    assert trainings.train(tiny, [HIGH])
    runs = trainings.trained(tiny.folder, HIGH)["ppo-paper"]
    before = [(run / "run.json").stat().st_mtime_ns for run in runs]
    assert trainings.seconds_left(tiny.folder, [HIGH, LOW]) == 2 * 16.0
    assert trainings.train(tiny, [HIGH]) and before == [(run / "run.json").stat().st_mtime_ns for run in runs]
    made = reproduce_curves(HIGH, tiny)
    assert [drawn.stem for drawn in made.figures] == ["learning-high-paper"]
    name, seeds, decisions, kept, last, _ = made.sheets[0].rows[0]
    assert (name, seeds, decisions) == ("ppo-paper", 2, "4,096")
    final = [learning.column(run, learning.HARM)[4096] for run in runs]
    assert last.value == pytest.approx(np.mean(final)) and kept.value <= last.value
    assert final[0] != final[1]  # other seeds
    (runs[1] / "run.json").unlink()
    assert trainings.trained(tiny.folder, HIGH) == {}  # one seed of two is missing
    nothing = reproduce_curves(HIGH, replace(tiny, full=False))
    assert nothing.verdict.outcome == "not run" and not nothing.figures


def test_unconverged__is_the_last_policy_and_goes_on_after_an_interruption(tiny: Settings, monkeypatch) -> None:
    interrupted = trainings.Plan("paper-random", "ppo", 256, 1, 1, 16)
    monkeypatch.setattr(trainings, "train", lambda *given: False)
    with refused("interrupted; repeat the command"):
        trainings.unconverged(tiny)
    monkeypatch.undo()
    run = tiny.folder / "trainings" / STOPPED / "ppo-seed0"
    monkeypatch.setattr(trainings, "GROUPS", {STOPPED: (interrupted,)})
    run.parent.mkdir(parents=True)
    recipe = {**TINY_RECIPE, "name": "ppo"}

    class Stop(Exception):
        pass

    def stop(progress: eb.Progress) -> None:
        if progress.done:
            raise Stop

    with pytest.raises(Stop):
        eb.train(recipe, "paper-random", run, on_progress=stop)
    assert not trainings.is_finished(run)
    spec = trainings.unconverged(tiny)
    assert spec == f"policy@{run / 'policy-last'}" and trainings.is_finished(run)
    assert eb.make_agent(spec, scenario="paper-random").policy.manifest.steps == 256
