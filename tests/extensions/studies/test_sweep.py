"""``ethbrake study sweep`` and ``tune``: files, tables, that nothing is lost, and that no disturbance shows."""

import json
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl as eb
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.studies.cluster import connected
from ethbrake_marl.extensions.studies.sweep import SweepFile, SweepPlan
from ethbrake_marl.extensions.studies.tuning import TuningFile, TuningPlan
from ethbrake_marl.files.yaml import read_yaml
from ethbrake_marl.training.recipe import TrainingRecipe, load_recipe
from ethbrake_marl.training.settings import read_settings
from ethbrake_marl.training.training import Training
from tests.extensions.studies.conftest import TRIALS, Write, study, write_yaml
from tests.extensions.studies.counting import PROGRAM, ROOT, end_when, finished, holders, works_for
from tests.fixtures.commands import rows_of as read
from tests.learning.tiny import marked

DOCS = ROOT / "docs"


GRID = {"scenario": "paper-random", "recipe": "ppo"}


KINDS: dict[str, tuple[Callable[[], Any], Callable[..., Any], Path]] = {
    "sweep": (SweepPlan.json_schema, SweepFile.read_as, DOCS / "sweep-example.yaml"),
    "tuning": (TuningPlan.json_schema, TuningFile.read_as, DOCS / "tuning-quick.yaml"),
    "recipe": (TrainingRecipe.json_schema, lambda path, *_: load_recipe(path), TrainingRecipe.shipped()["ppo"]),
}


TABLE = "results.csv"


def sweep(file: Path, folder: Path, *options: str) -> int:
    return study("sweep", file, "--output", folder, "--jobs", "1", *options)


@pytest.fixture
def again(finished_sweep: Path, small_sweep: dict[str, Any], tmp_path: Path) -> tuple[Path, Path]:
    """The file of the finished sweep, and a copy of its folder."""
    shutil.copytree(finished_sweep, tmp_path / "again")
    return write_yaml(tmp_path / "sweep.yaml", small_sweep), tmp_path / "again"


def test_grid__is_every_combination_seed_by_seed(write_sweep):
    scenarios, seeds = ["cooperation-2-paper", "cooperation-3-pair"], {"first": 4, "count": 2}
    grid = {"scenario": scenarios, "recipe": ["ppo", "sac"], "seed": seeds, "set": {"mass_t": [5, 6]}}
    plan = SweepPlan.read(write_sweep(set={"total_steps": 100}, grid=grid))
    assert len(plan.rows) == len({row.identity for row in plan.rows}) == 16
    assert [row.asked.seed for row in plan.rows] == [4] * 8 + [5] * 8
    asked = plan.rows[1].asked
    assert (asked.settings, asked.scenario) == (("total_steps=100", "mass_t=6"), "cooperation-2-paper")
    assert [*plan.rows[1].settings] == ["total_steps", "mass_t"]
    assert {row.first.recipe.total_steps for row in plan.rows} == {100}


def test_example__of_the_page_is_in_order():
    plan = SweepPlan.read(DOCS / "sweep-example.yaml")
    assert len(plan.rows) == 42 and {row.first.recipe.total_steps for row in plan.rows} == {200_000}
    assert (DOCS / "sweep-example.yaml").read_text("utf-8") in (DOCS / "extensions" / "studies.md").read_text("utf-8")


def test_table__has_a_row_for_every_job_in_the_order_of_the_file(finished_sweep):
    rows = read(finished_sweep / TABLE)
    assert [(row["seed"], row["set.gamma"]) for row in rows] == [
        ("3", "0.9"), ("3", "0.99"), ("5", "0.9"), ("5", "0.99")
    ]  # fmt: skip
    for row in rows:
        (run,) = (finished_sweep / "runs").glob(f"paper-random-tiny-seed{row['seed']}-{row['hash'][:16]}")
        assert row["policy_sha256"] == eb.load_policy(run).manifest.manifest_sha256
        assert (row["steps"], row["total_steps"], row["scheme"]) == ("256", "256", "single")
    assert {path.name for path in finished_sweep.iterdir()} == {".lock", TABLE, "runs"}


def test_job__is_the_training_that_train_makes(finished_sweep, tiny, tmp_path):
    row = read(finished_sweep / TABLE)[0]
    recipe = load_recipe(str(tiny)).replace(gamma=0.9)
    alone = eb.train(recipe, "paper-random", tmp_path / "alone", seed=3, on_progress=None)
    assert alone.training.identity == row["hash"]
    assert alone.policy.manifest.manifest_sha256 == row["policy_sha256"]
    least = min(alone.evaluations, key=lambda one: one["first_impact_harm"])
    assert float(row["first_impact_harm"]) == least["first_impact_harm"]
    assert float(row["last_total_harm"]) == alone.evaluations[-1]["total_harm"]


def test_finished_jobs__are_not_repeated_and_the_table_is_the_same(again, capsys) -> None:
    file, folder = again
    whole = (folder / TABLE).read_bytes()
    written = {path: path.stat().st_mtime_ns for path in (folder / "runs").glob("*/policy/manifest.json")}
    gone, lost, *_ = sorted((folder / "runs").iterdir())
    for damage, told in (
        ((folder / TABLE).unlink, "4 jobs finished in an earlier run"),
        (partial(shutil.rmtree, gone), "3 jobs finished in an earlier run"),
        ((lost / "policy" / "weights.safetensors").unlink, "3 jobs finished in an earlier run"),
    ):
        damage()
        assert sweep(file, folder) == 0 and told in capsys.readouterr().err
        assert (folder / TABLE).read_bytes() == whole
        others = {path for path in written if not {gone, lost} & {*path.parents}}
        assert len(others) == 2 and all(path.stat().st_mtime_ns == written[path] for path in others)


@pytest.mark.parametrize("damage", [b"steps,eval/first_impact_harm\nx,1.0\n", b"eval/first_impact_harm\n1\n", b"\xff"])
def test_table__of_a_run_that_is_damaged_is_named(again, capsys, damage: bytes) -> None:
    file, folder = again
    damaged = sorted((folder / "runs").iterdir())[0] / "progress.csv"
    damaged.write_bytes(damage)
    assert sweep(file, folder) == 2
    (told,) = capsys.readouterr().err.splitlines()
    assert f"{damaged}: the file is damaged (" in told and told.endswith("; delete the run's folder to train again")


def test_run__of_another_training_is_not_done(again, capsys) -> None:
    file, folder = again
    other = sorted((folder / "runs").iterdir())[0] / "config.json"
    config = json.loads(other.read_text())
    other.write_text(json.dumps({**config, "recipe": {**config["recipe"], "gamma": 0.9}}))
    assert sweep(file, folder) == 2
    (told,) = capsys.readouterr().err.splitlines()
    assert f"{other.parent}: this folder contains another training run, which differs in recipe gamma" in told


@pytest.mark.parametrize("name", [TABLE, "failures.csv"])
def test_file__that_cannot_be_written_at_the_end_is_told_at_once(write_sweep, tmp_path, capsys, name: str) -> None:
    (tmp_path / "out" / name).mkdir(parents=True)
    assert sweep(write_sweep(grid=GRID), tmp_path / "out") == 2
    assert f"{name}: is a folder; give the path of a file" in capsys.readouterr().err


@pytest.mark.slow
def test_team__that_has_lost_a_policy_is_trained_again(write_sweep: Write, tiny: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    job = {"scenario": "cooperation-3-pair", "recipe": str(tiny), "set": {"scheme": "independent", "total_steps": 1}}
    folder, file = tmp_path / "out", write_sweep(jobs=[job])
    assert sweep(file, folder) == 0
    whole = (folder / TABLE).read_bytes()
    (lost,) = folder.glob("runs/*/policy/vehicle_3")
    shutil.rmtree(lost)
    assert sweep(file, folder) == 0
    assert (folder / TABLE).read_bytes() == whole and (lost / "manifest.json").is_file()


def test_another_file__of_some_of_its_jobs_has_their_rows_alone(again, small_sweep) -> None:
    file, folder = again
    before = read(folder / TABLE)
    write_yaml(file, {"grid": {**small_sweep["grid"], "seed": [5]}})
    assert sweep(file, folder) == 0
    assert read(folder / TABLE) == [row for row in before if row["seed"] == "5"]


@pytest.mark.slow
def test_failures__end_in_a_table_with_their_reason(write_sweep, tiny, tmp_path, capsys):
    pytest.importorskip("ray")
    good = {"scenario": "paper-random", "recipe": str(tiny)}
    bad = {**good, "set": {"reward.harm": 1e300}}
    folder, file = tmp_path / "out", write_sweep(jobs=[bad, good])
    assert sweep(file, folder) == 1
    assert "1 of 2 jobs finished" in capsys.readouterr().err
    (failed,) = read(folder / "failures.csv")
    assert failed["reason"].startswith("training: ") and failed["set"] == "reward.harm=1e+300"
    assert [row["recipe"] for row in read(folder / TABLE)] == [str(tiny)]


@pytest.mark.slow
@pytest.mark.parametrize("work", ["counting", pytest.param("training", marks=pytest.mark.long)])
def test_disturbed_sweep__has_the_same_table(work: str, tiny: Path, write_sweep: Write, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    seeds = {"count": 20 if work == "counting" else 6}  # enough that some are left at the last signal
    file = write_sweep(grid={"scenario": "paper-random", "recipe": str(tiny), "seed": seeds})
    program = {"counting": [sys.executable, "-m", "tests.extensions.studies.counting", str(file)]}
    program["training"] = [*PROGRAM, "study", "sweep", str(file), "--output"]
    command, folder = [*program[work], str(tmp_path / "out"), "--jobs", "2"], tmp_path / "out"
    alone = [*program[work], str(tmp_path / "alone"), "--jobs", "1"]
    subprocess.run(alone, cwd=ROOT, stderr=subprocess.DEVNULL, check=True)
    for number, by, status in ((1, signal.SIGKILL, -signal.SIGKILL), (2, signal.SIGINT, 130), (3, signal.SIGTERM, 130)):

        def ready(driver: int, number: int = number) -> bool:  # workers of the driver before may go on for a moment
            return finished(folder) >= number and any(works_for(each, driver) for each in holders(folder))

        found, _ = end_when(command, ready, by)
        assert found == status
        while holders(folder):  # processes whose driver was killed end by themselves
            time.sleep(0.01)
    ended = subprocess.run(command, cwd=ROOT, stderr=subprocess.PIPE, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    assert (folder / TABLE).read_bytes() == (tmp_path / "alone" / TABLE).read_bytes()


@pytest.mark.slow
def test_connected__leaves_the_handlers_of_signals_as_they_were() -> None:
    pytest.importorskip("ray")
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
    before = [signal.getsignal(number) for number in numbers]
    with connected("local", 1):
        for number in numbers:  # as Ray Tune does
            signal.signal(number, lambda number, frame: None)
    assert [signal.getsignal(number) for number in numbers] == before


@pytest.mark.parametrize(("kind", "package"), [("sweep", "ray"), ("tuning", "ray"), ("tuning", "optuna")])
def test_extra__that_is_missing_is_named_before_anything_is_made(
    kind: str, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    file, command = next(DOCS.glob(f"{kind}-*.yaml")), {"sweep": "sweep", "tuning": "tune"}[kind]
    assert run_command(["study", command, str(file), "--output", str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err
    assert f"needs the package {package}" in told and told.endswith("-m pip install 'ethbrake-marl[cluster]'\n")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", ["sweep", "tuning"])
def test_schema__says_what_every_key_means_and_lets_the_examples_pass(kind: str) -> None:
    schema = KINDS[kind][0]()
    parts = {"the file": schema, **schema["$defs"]}
    keys = {f"{part}.{key}": value for part, inner in parts.items() for key, value in inner["properties"].items()}
    assert [key for key, value in keys.items() if not value.get("description")] == []
    examples = [read_yaml(path).content for path in DOCS.glob(f"{kind}-*.yaml")]
    assert examples and [marked(schema, content) for content in examples] == [set()] * len(examples)
    assert marked(schema, {"title": "Nothing is asked for"}) == {""}


@pytest.mark.parametrize(
    ("kind", "change", "place"),
    [
        ("sweep", {"grid": {**GRID, "seed": 3}}, None),
        ("sweep", {"grid": {"scenario": ["a", "b"], "recipe": ["ppo"], "seed": [0, 1]}, "jobs": []}, None),
        ("sweep", {"jobs": [{"scenario": "a", "recipe": "ppo"}]}, None),
        ("tuning", {"prune": None}, None),
        ("tuning", {"search": {"holds": {"choices": [[1], "x", 3]}}}, None),
        ("tuning", {"search": {"gamma": {"low": 0.5, "high": 1, "log": True}}}, None),
        ("sweep", {"gird": GRID}, ""),
        ("sweep", {"grid": {**GRID, "level": "2-paper"}}, "grid"),
        ("sweep", {"grid": {"recipe": "ppo"}}, "grid"),
        ("sweep", {"grid": {**GRID, "seed": [-1]}}, "grid.seed"),
        ("sweep", {"grid": {**GRID, "seed": {"first": 1}}}, "grid.seed"),
        ("sweep", {"grid": {**GRID, "recipe": []}}, "grid.recipe"),
        ("sweep", {"grid": {**GRID, "set": {"gamma": 0.9}}}, "grid.set.gamma"),
        ("sweep", {"jobs": [{"scenario": "paper-random"}]}, "jobs.0"),
        ("sweep", {"jobs": [{**GRID, "seed": [1]}]}, "jobs.0.seed"),
        ("tuning", {"serach": {"n_epochs": {"low": 1, "high": 4}}}, ""),
        ("tuning", {"search": {}}, "search"),
        ("tuning", {"search": {"gamma": {"low": 0.5}}}, "search.gamma"),
        ("tuning", {"search": {"gamma": {"low": "a", "high": 1}}}, "search.gamma"),
        ("tuning", {"search": {"gamma": {"choices": [0.9]}}}, "search.gamma"),
        ("tuning", {"measure": {"worlds": 0}}, "measure.worlds"),
        ("tuning", {"prune": {"keep": 1.0}}, "prune"),
        ("tuning", {"sampler": {"name": "grid"}}, "sampler.name"),
        ("tuning", {"seed": None}, "seed"),
        ("tuning", {"search": "-"}, ""),
        ("recipe", {"algorithm": "-"}, ""),
        ("recipe", {"gamma": "-"}, ""),
        ("recipe", {"algorithm": "nobody"}, "algorithm"),
        ("recipe", {"gama": 0.9}, ""),
        ("recipe", {"buffer_size": 1000}, ""),  # a key of another algorithm
        ("recipe", {"gamma": 2}, "gamma"),
        ("recipe", {"total_steps": 0.5}, "total_steps"),
        ("recipe", {"seed": -1}, "seed"),
        ("recipe", {"name": "Mine!"}, "name"),
        ("recipe", {"scheme": "together"}, "scheme"),
        ("recipe", {"reward": {"harm": -1}}, "reward.harm"),
        ("recipe", {"reward": {"harmm": 1}}, "reward"),
        ("recipe", {"network": {"policy": [], "value": [8]}}, "network.policy"),
        ("recipe", {"observation": ["own", "own"]}, "observation"),
        ("recipe", {"learning_rate": 0.001}, "learning_rate"),
    ],
)
def test_schema__marks_what_the_reader_refuses_and_that_alone(
    kind: str, change: dict[str, Any], place: str | None, tmp_path: Path
) -> None:
    """A key that is changed to "-" is left out."""
    schema, read, example = KINDS[kind]
    content = {key: value for key, value in {**read_yaml(example).content, **change}.items() if value != "-"}
    assert marked(schema(), content) == ({place} - {None})
    with nullcontext() if place is None else pytest.raises(InvalidInput):
        read(write_yaml(tmp_path / "mine.yaml", content), "")


# ---------------------------------------------------------------- tuning


def test_every_trial__is_measured_as_often_whatever_an_update_holds(write_tuning):
    file = write_tuning(recipe="ppo", search={"n_envs": {"choices": [16, 128, 256]}}, measure={"times": 7, "seed": 3})
    plan = TuningPlan.read(file)
    for n_envs in (16, 128, 256):
        recipe = plan.training({"n_envs": n_envs}).recipe
        updates, every = plan.updates(recipe), recipe.evaluation.every_updates
        assert (recipe.evaluation.seed, recipe.seed, recipe.n_envs) == (3, 0, n_envs)
        steps = [7 * update // updates for update in {*range(0, updates, every), updates}]
        assert len(set(steps)) == len(steps) and 6 <= len(steps) <= 8 and max(steps) == 7


@pytest.mark.parametrize(
    ("search", "own"),
    [
        (
            {"network.policy": {"choices": [[9], [8]]}, "vf_coef": {"low": 0, "high": 1.0}},
            {"network.policy": [8], "vf_coef": 0.5},
        ),
        ({"gamma": {"low": 0, "high": 1}}, None),  # whole numbers alone, and the recipe has 0.995
        ({"max_grad_norm": {"low": 0.6, "high": 0.9}}, None),
    ],
)
def test_own_values__are_the_recipes_where_the_space_has_them(write_tuning, search, own):
    assert TuningPlan.read(write_tuning(search=search)).own_values() == own


def test_identity__is_that_of_all_that_changes_a_trial(write_tuning):
    others = [{"seed": 1}, {"set": {"mass_t": 9}}, {"measure": {"seed": 12}}, {"prune": None}, {"sampler": {"seed": 1}}]
    same, titled, *found = (
        str(TuningPlan.read(write_tuning(**changes)).question) for changes in ({}, {"title": "words"}, *others)
    )
    assert titled == same and len({same, *found}) == len(others) + 1


def test_shipped_space__is_in_order_holds_its_recipe_and_is_the_one_of_the_page():
    file = DOCS / "tuning-quick.yaml"
    plan = TuningPlan.read(file)
    assert plan.own_values() is not None and plan.file.recipe in eb.TrainingRecipe.shipped()
    assert file.read_text("utf-8") in (DOCS / "extensions" / "studies.md").read_text("utf-8")


TRIALS_TABLE = "trials.csv"


def tune(file: Path, folder: Path, *options: str) -> int:
    return study("tune", file, "--output", folder, "--trials", TRIALS, *options)


def run_of(folder: Path, row: dict[str, str], file: str) -> dict[str, Any]:
    """A file of a trial's run."""
    found: dict[str, Any] = json.loads((folder / "trials" / row["hash"][:16] / file).read_text())
    return found


def test_table__has_every_trial_the_first_with_the_recipes_own_values(finished_tuning: Path) -> None:
    rows = read(finished_tuning / TRIALS_TABLE)
    assert [row["trial"] for row in rows] == [str(number) for number in range(TRIALS)]
    own = {"learning_rate.start": "0.001", "n_epochs": "2", "network.policy": "[8]"}
    assert rows[0].items() >= own.items()
    for row in rows:
        assert 1e-4 <= float(row["learning_rate.start"]) <= 1e-1 and row["n_epochs"] in "1234" and not row["reason"]
        recipe = run_of(finished_tuning, row, "config.json")["recipe"]
        assert recipe["learning_rate"]["start"] == float(row["learning_rate.start"])
        assert recipe["evaluation"] == {"every_updates": 1, "worlds": 10, "seed": 11}


def test_dry_run__tells_how_many_trials_of_what_and_a_command_that_trains_the_first(
    finished_tuning: Path, write_tuning: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = write_tuning()
    recipe = TuningPlan.read(file).file.recipe
    assert tune(file, finished_tuning, "--trials", "7", "--dry-run") == 0
    head, *_, last = capsys.readouterr().out.splitlines()
    assert head == (
        f"7 trials ({TRIALS} of them begun): recipe {recipe} in scenario paper-random;"
        " 512 decisions per trial that is not pruned"
    )
    assert last.startswith(f"the first trial: ethbrake train --scenario paper-random --recipe {recipe} --seed 0 --set ")
    settings = [word for word in shlex.split(last) if "=" in word]
    trained = read_settings(settings, [load_recipe(recipe)]).change(load_recipe(recipe))
    identity = Training.of(trained, eb.load_scenario("paper-random")).identity
    assert identity == read(finished_tuning / TRIALS_TABLE)[0]["hash"]
    other = write_tuning(search={"max_grad_norm": {"low": 0.6, "high": 0.9}})  # the recipe has 0.5
    assert tune(other, tmp_path / "new", "--dry-run") == 0
    assert "\nexample of a trial: ethbrake train " in capsys.readouterr().out and not (tmp_path / "new").exists()


def test_pruned_trials__stop_early_with_more_harm_than_the_median_had(finished_tuning: Path) -> None:
    rows = read(finished_tuning / TRIALS_TABLE)
    pruned, finished = ([row for row in rows if row["state"] == state] for state in ("pruned", "finished"))
    assert pruned and len(finished) >= 2 and {row["steps"] for row in finished} == {"512"}
    least = min(float(row["first_impact_harm"]) for row in finished)
    for row in pruned:
        assert 0 < int(row["steps"]) < 512 and float(row["first_impact_harm"]) > least and not row["policy_sha256"]
        run = run_of(finished_tuning, row, "run.json")  # the last one's process may have ended before it was closed
        assert run["status"] == "running" or run["reason"].startswith("pruned: ")


def test_export__is_a_recipe_that_trains_the_best_trial_again_to_the_bit(finished_tuning, tmp_path):
    rows = [row for row in read(finished_tuning / TRIALS_TABLE) if row["state"] == "finished"]
    best = min(rows, key=lambda row: float(row["first_impact_harm"]))
    file = finished_tuning.parent / "best.yaml"
    again = eb.train(eb.load_recipe(file), "paper-random", tmp_path / "again", on_progress=None)
    assert again.policy.manifest.manifest_sha256 == best["policy_sha256"]
    assert min(each["first_impact_harm"] for each in again.evaluations) == float(best["first_impact_harm"])
    text = file.read_text()
    assert f"trial {best['trial']}, {float(best['first_impact_harm'])!r}" in text and "name: best\n" in text
    assert "ethbrake train --scenario paper-random --recipe best.yaml" in text


@pytest.mark.slow
def test_trials__that_ended_are_kept_and_more_go_on_as_if_they_had_been_asked_for_at_once(
    finished_tuning, write_tuning, tmp_path, capsys
):
    folder, file, whole = tmp_path / "out", write_tuning(), (finished_tuning / TRIALS_TABLE).read_bytes()
    assert tune(file, folder, "--trials", "2") == 0
    assert [row["trial"] for row in read(folder / TRIALS_TABLE)] == ["0", "1"]
    (kept,) = (folder / "trials").glob(f"{read(folder / TRIALS_TABLE)[1]['hash'][:16]}/run.json")
    written = kept.stat().st_mtime_ns
    capsys.readouterr()
    assert tune(file, folder, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert sum(told["trials"].values()) == TRIALS and told["best"]["harm"] > 0.0 and not told["interrupted"]
    assert (folder / TRIALS_TABLE).read_bytes() == whole and kept.stat().st_mtime_ns == written


@pytest.mark.long
def test_disturbed_tuning__has_the_same_table(finished_tuning, write_tuning, tmp_path):
    folder, export = tmp_path / "out", tmp_path / "best.yaml"
    options = ["--output", folder, "--trials", str(TRIALS), "--export", export]
    command = [*PROGRAM, "study", "tune", write_tuning(), *options]
    for trials, by, status in ((2, signal.SIGKILL, -signal.SIGKILL), (4, signal.SIGINT, 130)):
        found, _ = end_when(command, lambda _, trials=trials: len([*folder.glob("trials/*/run.json")]) >= trials, by)
        assert found == status
    assert not export.exists()  # or the same command could not go on
    done = subprocess.run(command, cwd=ROOT, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (folder / TRIALS_TABLE).read_bytes() == (finished_tuning / TRIALS_TABLE).read_bytes()
    assert export.read_text() == (finished_tuning.parent / "best.yaml").read_text()


@pytest.mark.slow
def test_trial__that_diverges_is_failed_with_its_reason_and_the_others_go_on(write_tuning, tmp_path, capsys) -> None:
    pytest.importorskip("ray")
    file = write_tuning(search={"reward.harm": {"choices": [0.05, 1e300]}}, sampler={"name": "random"})
    assert tune(file, tmp_path / "out", "--trials", "4") == 0
    rows = read(tmp_path / "out" / TRIALS_TABLE)
    failed = [row for row in rows if row["state"] == "failed"]
    assert {row["reward.harm"] for row in failed} == {"1e+300"} and failed[0]["reason"].startswith("training: ")
    assert rows[0]["state"] == "finished" and "1 finished" not in capsys.readouterr().err
    assert len(list((tmp_path / "out" / "trials").iterdir())) == 2  # the same is not trained twice
    nothing, export = write_tuning(search={"reward.harm": {"low": 1e299, "high": 1e300}}), tmp_path / "best.yaml"
    assert tune(nothing, tmp_path / "none", "--trials", "1", "--export", str(export)) == 1
    assert "no trial has the recipe's own values" in capsys.readouterr().err and not export.exists()


def test_same_command__exports_again_over_its_own_recipe_alone(finished_tuning, tmp_path, capsys) -> None:
    shutil.copytree(finished_tuning.parent, tmp_path / "all")
    file, export = tmp_path / "all" / "tuning.yaml", tmp_path / "all" / "best.yaml"
    text = export.read_text()
    assert "Settings of" in text and tune(file, tmp_path / "all" / "out", "--export", str(export)) == 0
    assert export.read_text() == text
    best, *_ = capsys.readouterr().out.splitlines()
    assert best.startswith("best: trial ") and ", first_impact_harm " in best and best.endswith(" m²/s²")
    for other, folder in ((text[1:], "out"), (text, "another")):
        export.write_text(other)
        assert tune(file, tmp_path / "all" / folder, "--export", str(export)) == 2
        assert "best.yaml: already exists; give another name, or pass force=True" in capsys.readouterr().err
        assert export.read_text() == other
