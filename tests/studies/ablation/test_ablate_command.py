"""``ethbrake study ablate``: what it writes, that it goes on, and what it refuses."""

from __future__ import annotations

import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.episodes import Passport
from ethbrake_marl.learning import runs as learning_train
from ethbrake_marl.learning.training import Scheme, TrainingRecipe, load_recipe
from ethbrake_marl.studies.ablation import Plan, plan_ablation, read_levels, with_scheme
from ethbrake_marl.studies.jobs import TrainingJob
from tests.fixtures.pictures import draw_nothing

LEVELS = "cooperation-0-sensors,cooperation-3-pair,cooperation-3-congested"
SMALL = ["--levels", LEVELS, "--seeds", "2", "--episodes", "20", "--search-episodes", "4", "--budget", "50"]
SMALL += ["--steps", "128", "--scheme", "shared"]


@pytest.fixture(scope="module")
def ablation(tmp_path_factory, tiny) -> Path:
    """The folder of a small ablation; not to be changed."""
    folder = tmp_path_factory.mktemp("ablation") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        draw_nothing(patch)
        assert run_command(["study", "ablate", "--output", str(folder), "--recipes", str(tiny), *SMALL]) == 0
    return folder


def refused(capsys, *arguments: str | Path) -> str:
    capsys.readouterr()
    assert run_command(["study", "ablate", *(str(argument) for argument in arguments)]) == 2
    return capsys.readouterr().err


def content(folder: Path) -> dict:
    found = json.loads((folder / "ablation.json").read_text())
    for varying in ("machine", "date"):
        found["settings"].pop(varying)
    return found


def test_ablate__writes_tables_and_figures(ablation):
    names = {"ablation.json", "ablation.csv", "ablation.md", "ablation.png", "ablation-changes.png",
             "ablation-who-pays.png", "ablation.html"}  # fmt: skip
    assert names <= {path.name for path in ablation.iterdir()}
    found = content(ablation)
    assert [level["level"] for level in found["levels"]] == LEVELS.split(",")
    assert [level["seeds"] for level in found["levels"]] == [1, 2, 2]
    assert {found["kind"], *(level["kind"] for level in found["levels"])} == {"ablate"}
    assert len({level["scenario_sha256"] for level in found["levels"]}) == 3
    learned = found["levels"][1]
    assert len(learned["worlds_sha256"]) == 64 and learned["versions"]["numpy"]
    assert len({seed["vehicle_2"] for seed in learned["policy_sha256"]}) == 2
    assert found["levels"][0]["policy_sha256"] == [{}]
    assert [(step["from"], step["to"]) for step in found["channels"]] == [
        ("cooperation-3-pair", "cooperation-3-congested")
    ]
    pair = found["levels"][1]["total"]
    assert pair["searched"]["best_known"]["value"] <= pair["searched"]["full_brake"]["value"]


@pytest.mark.slow
def test_ablate__the_shield_goes_around_what_was_trained(ablation, tmp_path, tiny, capsys):
    """The trainings of the other ablation are used, in a copy without its settings."""
    folder = tmp_path / "shielded"
    shutil.copytree(ablation, folder)
    words = ["--output", folder, "--recipes", tiny, *SMALL, "--shield"]
    assert "other settings (shield None, here step)" in refused(capsys, *words, "step")
    (folder / "settings.json").unlink()
    assert "shield 'robust': must be step" in refused(capsys, *words, "robust")
    assert run_command(["study", "ablate", *map(str, words), "step"]) == 0
    assert "to do: 0 trainings" in capsys.readouterr().err
    found, alone = content(folder), content(ablation)
    assert found["settings"]["shield"] == "step" and alone["settings"]["shield"] is None
    assert found["levels"][0]["first"]["shielded"] is None
    for level, before in zip(found["levels"][1:], alone["levels"][1:], strict=True):
        for count in ("first", "total"):
            told = level[count].pop("shielded")
            assert told["above_bound"] == 0 and told["harm"]["value"] <= told["bound"]["value"]
            difference = told["harm"]["value"] - level[count]["harm"]["value"]
            assert told["difference"]["value"] == pytest.approx(difference) and difference < -1.0
            assert 0.1 < told["replaced"] == pytest.approx(sum(told["replaced_vehicles"]) / 2)
            assert before[count].pop("shielded") is None
    assert found["levels"][1:] == alone["levels"][1:]  # without the shield as before
    assert "Behind the step shield" in (folder / "ablation.html").read_text("utf-8")


@pytest.mark.parametrize("column", [0, 1])
def test_page__plays_the_same_worlds_at_every_level(ablation, column):
    html = (ablation / "ablation.html").read_text("utf-8")
    assert len(html) <= 5 << 20
    told = html.split('<script type="application/json" id="episode_data">')[1].partition("</script>")[0]
    content = json.loads(told)
    assert content["agents"] == LEVELS.split(",")
    assert [episode["driven"] for episode in content["worlds"][0]["episodes"]] == [[], [1, 2], [1, 2]]
    assert 3 <= len(content["worlds"]) <= 7
    passport = Passport.parse(content["worlds"][2]["episodes"][column]["passport"])
    (folder,) = (ablation / "trainings").glob("cooperation-3-pair-*-seed0")
    again = passport.replay(agent=f"ppo@{folder}" if column else None)
    assert again.same and again.passport.policy_sha == passport.policy_sha


@pytest.mark.slow
def test_ablate__goes_on_where_it_was_stopped_to_the_same_result(ablation, tmp_path, tiny, monkeypatch, capsys):
    """Stopped in the middle of the second training; ended by two processes."""
    folder, trained = tmp_path / "stopped", []

    def stop_in_the_second(recipe, scenario, path, **options):
        trained.extend([path.name] if path.name != "timed" else [])
        if len(trained) == 2:
            calls = []
            monkeypatch.setattr(learning_train.Session, "_after_update", _stopping(calls, learning_train.Session))
        return keep(recipe, scenario, path, **options)

    keep = learning_train.train
    with monkeypatch.context() as patch:
        patch.setattr(learning_train, "train", stop_in_the_second)
        patch.setattr(learning_train.Session, "_after_update", learning_train.Session._after_update)
        assert run_command(["study", "ablate", "--output", str(folder), "--recipes", str(tiny), *SMALL]) == 130
    monkeypatch.undo()
    half = folder / "trainings" / trained[1]
    assert json.loads((half / "run.json").read_text())["status"] != "finished"
    assert not (folder / "ablation.json").exists()
    capsys.readouterr()
    assert run_command(["study", "ablate", "--output", str(folder), "--recipes", str(tiny), *SMALL, "--jobs", "2"]) == 0
    assert "to do: 3 trainings" in capsys.readouterr().err
    assert content(folder) == content(ablation)


def _stopping(calls: list[int], callback):
    original = callback._after_update

    def after_update(self, **options):
        original(self, **options)
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt

    return after_update


def test_ablate__states_the_cost_first(ablation, tiny, capsys):
    capsys.readouterr()
    words = ["study", "ablate", "--output", str(ablation), "--recipes", str(tiny), *SMALL, "--cost"]
    before = (ablation / "ablation.json").stat().st_mtime_ns
    assert run_command(words) == 0
    assert "to do: 0 trainings, 0 decisions: 0 s; joint optima 0 s;" in capsys.readouterr().err
    assert run_command([*words, "--seeds", "3"]) == 0
    assert "to do: 2 trainings, 512 decisions at" in capsys.readouterr().err
    assert (ablation / "ablation.json").stat().st_mtime_ns == before


def test_ablate__damaged_parts_of_a_search_are_told_with_the_cost(ablation, tmp_path, tiny, capsys):
    folder = tmp_path / "copy"
    shutil.copytree(ablation, folder)
    damaged = next((folder / "optimum").glob("*/*.npz"))
    damaged.write_bytes(b"no table")
    assert run_command(["study", "ablate", "--output", str(folder), "--recipes", str(tiny), *SMALL, "--cost"]) == 0
    assert f"{damaged}: is damaged; its worlds are searched again" in capsys.readouterr().err


def test_ablate__bad_input_is_refused(tmp_path, tiny, capsys):
    start = ["--output", tmp_path / "new", "--recipes", tiny]
    assert "cooperation-3-pair" in refused(capsys, *start, "--levels", "cooperation-3-par,cooperation-2-paper")
    assert "seeds = 0: must be a whole number, at least 1" in refused(capsys, *start, "--seeds", "0")
    assert "at most the 10 worlds" in refused(capsys, *start, "--episodes", "10", "--search-episodes", "11")
    assert "scheme" in refused(capsys, *start, "--scheme", "shard")
    assert "jobs = 0: must be a whole number in 1..64" in refused(capsys, *start, "--jobs", "0")
    only = "cooperation-0-sensors,paper-distance"
    assert "is a file; give a folder" in refused(capsys, "--output", tiny, "--recipes", tiny)
    assert "is a file; give a folder" in refused(capsys, "--output", tiny / "new", "--recipes", tiny)
    assert "each with a name of its own" in refused(capsys, *start, "--recipes", f"{tiny},{tiny}")
    assert "differs from that of" in refused(capsys, *start, "--levels", only)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("damage", "what"),
    [
        (lambda folder: (folder / "run.json").write_text("{"), "run.json: is damaged"),
        (lambda folder: (folder / "config.json").write_text("[]"), "config.json: is damaged"),
        (lambda folder: (folder / "run.json").unlink(), "is no training"),
        (lambda folder: (folder / "team.json").write_text("{}"), "team.json"),
        (lambda folder: (folder / "policy" / "manifest.json").write_text("{}"), "manifest.json"),
    ],
)
def test_ablate__a_damaged_folder_is_named(ablation, tmp_path, tiny, capsys, damage, what):
    folder = tmp_path / "copy"
    shutil.copytree(ablation, folder)
    damage(folder / "trainings" / "cooperation-3-pair-tiny-shared-seed1")
    assert what in refused(capsys, "--output", folder, "--recipes", tiny, *SMALL)


def test_ablate__damage_is_told_before_anything_is_searched(ablation, tmp_path, tiny, capsys):
    folder = tmp_path / "copy"
    shutil.copytree(ablation, folder)
    shutil.rmtree(folder / "optimum")
    shutil.rmtree(folder / "trainings" / "cooperation-3-pair-tiny-shared-seed0")
    (folder / "trainings" / "cooperation-3-congested-tiny-shared-seed1" / "team.json").write_text("{}")
    assert "team.json" in refused(capsys, "--output", folder, "--recipes", tiny, *SMALL)
    assert not (folder / "optimum").exists() and len(list((folder / "trainings").iterdir())) == 3


def test_ablate__another_training_in_the_folder_is_refused(ablation, tmp_path, tiny, capsys):
    shutil.copytree(ablation, tmp_path / "copy")
    (tmp_path / "copy" / "settings.json").unlink()
    err = refused(capsys, "--output", tmp_path / "copy", "--recipes", tiny, *SMALL, "--steps", "4096")
    assert "holds another training (here other: recipe total_steps); give another folder" in err


def test_ablate__other_settings_in_the_folder_are_refused_and_nothing_is_lost(ablation, tmp_path, tiny, capsys):
    before = {path: path.read_bytes() for path in ablation.rglob("*") if path.is_file()}
    start = ["--output", ablation, "--recipes", tiny, *SMALL]
    assert "(budget 50, here 60)" in refused(capsys, *start, "--budget", "60")
    err = refused(capsys, *start, "--seeds", "3", "--levels", "cooperation-3-pair,cooperation-0-sensors")
    assert "other settings (levels; seeds 2, here 3); give another folder" in err
    assert {path: path.read_bytes() for path in ablation.rglob("*") if path.is_file()} == before
    (tmp_path / "settings.json").write_text("[]")
    assert "settings.json: is damaged" in refused(capsys, "--output", tmp_path, "--recipes", tiny, *SMALL)


def test_ablate__the_cost_of_a_new_folder_makes_nothing(tmp_path, tiny, capsys):
    words = ["--levels", "cooperation-0-sensors,cooperation-2-paper", "--episodes", "5", "--search-episodes", "1"]
    words += ["--budget", "1", "--seeds", "1", "--steps", "64"]
    assert (
        run_command(["study", "ablate", "--output", str(tmp_path / "new"), "--recipes", str(tiny), *words, "--cost"])
        == 0
    )
    assert "to do: 1 trainings, 64 decisions" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def planned(recipe: TrainingRecipe, scheme: Scheme | None) -> list[tuple[str, TrainingJob, TrainingRecipe]]:
    """Algorithm, training and its recipe, level by level."""
    levels = tuple(read_levels(["cooperation-2-paper", "cooperation-3-pair"]))
    plan = Plan(levels, (with_scheme(recipe, scheme),), 1, 300, 10, 7, 5, 10, Path("any"))
    return [(algorithm, job, job.training.recipe) for _, algorithm, job in plan.trainings()]


def test_plan__one_learner_is_trained_alone_whatever_the_scheme(tiny):
    recipe = load_recipe(str(tiny))
    (_, _, alone), (_, job, pair) = first, _ = planned(recipe, None)
    assert (alone.scheme, pair.scheme) == (None, "shared")
    assert (alone.total_steps, pair.total_steps) == (300, 600)
    assert job.folder.name == "cooperation-3-pair-tiny-shared-seed0"
    again, (shared, _, _) = planned(recipe, "shared")
    assert again[1:] == first[1:]
    assert again[1].folder.name == "cooperation-2-paper-tiny-seed0" and again[0] == shared == "tiny-shared"


def test_plan__the_recipes_own_scheme_holds_and_turns_are_for_several(tiny):
    recipe = load_recipe(str(tiny))
    assert [own.scheme for *_, own in planned(recipe.replace(scheme="shared"), None)] == [None, "shared"]
    (*_, alone), (*_, pair) = planned(recipe.replace(scheme="independent", turns=2), None)
    assert (alone.turns, pair.turns) == (None, 2)
    with pytest.raises(InvalidInput, match="turns"):
        planned(recipe.replace(scheme="independent", turns=5), "shared")


@pytest.mark.slow
def test_ablate__an_interruption_reaches_the_trainings_of_other_processes(tmp_path, tiny):
    folder = tmp_path / "stopped"
    command = [
        sys.executable,
        "-c",
        "from ethbrake_marl.cli.app import main; main()",
        "study",
        "ablate",
        "--output",
        str(folder),
    ]
    command += ["--recipes", str(tiny), *SMALL, "--steps", "1000000", "--jobs", "2"]
    command += ["--levels", "cooperation-0-sensors,cooperation-2-paper"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    try:
        _wait_for(lambda: len(list(folder.glob("trainings/*/checkpoints"))) == 2, process)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=300)
    finally:
        process.kill()
        process.wait()
        process.stderr.close()
    assert process.returncode == 130 and "interrupted; the same command goes on" in err
    statuses = [json.loads(path.read_text())["status"] for path in folder.glob("trainings/*/run.json")]
    assert len(statuses) == 2 and set(statuses) == {"interrupted"}


def _wait_for(happened, process) -> None:
    end = time.monotonic() + 900.0  # two processes that may have to compile every kernel first
    while not happened():
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.1)


@pytest.mark.parametrize("name", ["seeds", "steps_per_learner", "episodes", "search_episodes", "budget"])
def test_plan__of_no_seeds_or_worlds_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=f"{name} = 0: must be a whole number, at least 1"):
        plan_ablation(None, "cooperation", None, None, quick=True, list_seed=7, folder=tmp_path / "a", **{name: 0})
