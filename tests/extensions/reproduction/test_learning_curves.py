"""Learning curves of several trainings."""

import re
import signal

import pytest
import yaml

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.identity import scenario_sha256, worlds_sha256
from ethbrake_marl.extensions.reproduction.learning_curves import LearningCurves
from ethbrake_marl.progress import Progress
from tests.fixtures.commands import TINY_RECIPE, rows_of

SCENARIO = eb.load_scenario("paper-random")


def test_curves__are_trained_drawn_and_gone_on_with(tiny_recipe, tiny_sac, tmp_path) -> None:
    folder = tmp_path / "curves"
    curves = LearningCurves(SCENARIO, [(eb.load_recipe(each), 2) for each in (tiny_recipe, tiny_sac)], folder)

    def press(progress: Progress) -> None:
        if (progress.name, progress.done) == ("tiny-seed1", 128):
            signal.raise_signal(signal.SIGINT)

    assert not curves.train(tell=press)
    manifest = folder / "tiny-seed0" / "policy" / "manifest.json"
    kept = manifest.stat().st_mtime_ns
    assert curves.train()
    summary = curves.write()
    assert manifest.stat().st_mtime_ns == kept
    assert (folder / "learning_curves.png").read_bytes().startswith(b"\x89PNG")
    rows = [row for row in rows_of(folder / "learning_curves.csv") if row["figure"] != "return"]
    harms = {(row["recipe"], row["seed"], int(row["steps"])): float(row["value"]) for row in rows}
    steps = {name: {each[2] for each in harms if each[0] == name} for name in ("tiny", "tiny-sac")}
    assert steps == {"tiny": {0, 128, 256}, "tiny-sac": {0, 160, 320}}
    told, last = summary["recipes"]["tiny"], [harms["tiny", seed, 256] for seed in "01"]
    low, high = told["last"]["interval"]
    assert (told["last"]["each"], told["last"]["interquartile_mean"]) == (last, pytest.approx(sum(last) / 2))
    assert min(last) <= low <= high <= max(last)
    fixed = SCENARIO.sample(10, 7)
    assert (summary["kind"], summary["scenario_sha256"]) == ("learning-curves", scenario_sha256(SCENARIO))
    assert told["worlds_sha256"] == worlds_sha256(fixed.worlds, fixed.index)
    policies = [eb.load_policy(folder / f"tiny-seed{seed}").manifest.manifest_sha256 for seed in (0, 1)]
    assert told["policy_sha256"] == policies
    curves._replace(against="cpu").write()
    spent = [float(row["cpu_s"]) for row in rows_of(folder / "learning_curves.csv")[:3]]
    assert 0.0 <= spent[0] < spent[1] < spent[2]


def test_curves__another_training_or_an_edited_scenario_is_told_before_any_is_begun(
    tiny_recipe, scenario_file, tmp_path
) -> None:
    folder, other = tmp_path / "curves", tmp_path / "other.yaml"
    other.write_text(yaml.safe_dump({**TINY_RECIPE, "gamma": 0.9}))

    def curves(recipes: list[object], old: str, new: str) -> None:
        plan = [(eb.load_recipe(recipe), 1) for recipe in recipes]
        asked = LearningCurves(eb.load_scenario(scenario_file(old, new)), plan, folder)
        assert asked.train()
        asked.write()

    curves([tiny_recipe], "horizon_s: 8", "horizon_s: 8")
    drawn = (folder / "learning_curves.json").stat().st_mtime_ns
    for recipes, horizon, what in (
        ([tiny_recipe], "horizon_s: 9", "scenario horizon_s"),
        (["ppo", other], "horizon_s: 8", "recipe gamma"),
    ):
        told = f"tiny-seed0: this folder contains another training run, which differs in {what}; choose another folder"
        with pytest.raises(InvalidInput, match=re.escape(told)):
            curves(recipes, "horizon_s: 8", horizon)
    assert (folder / "learning_curves.json").stat().st_mtime_ns == drawn and not (folder / "ppo-seed0").exists()
    # Words change no training: its result is kept.
    curves([tiny_recipe], 'title: "One-line title for lists and figures"', 'title: "Another line"')
