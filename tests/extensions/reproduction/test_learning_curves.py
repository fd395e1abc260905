"""Learning curves of several trainings."""

import signal

import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.reproduction.learning_curves import LearningCurves
from ethbrake_marl.first_edition.evaluation.identity import scenario_sha256, worlds_sha256
from ethbrake_marl.progress import Progress
from tests.fixtures.commands import rows_of

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
