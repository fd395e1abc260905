"""One contract for every folder of jobs: its cost, other settings, somebody else's files, a second process, damage."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from filelock import FileLock

from ethbrake_marl.cli.app import run_command
from tests.studies.conftest import ABLATE, TRIALS


class Study(NamedTuple):
    """A command, the folder of its finished work, one with other settings, its refusal, and where they are kept."""

    line: tuple[object, ...]
    folder: Path
    other: tuple[object, ...] = ()
    told: str = ""
    record: str = ""


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folders of a sharded evaluation and of a reproduction; not to be changed."""
    folder = tmp_path_factory.mktemp("done")
    assert run_command(["evaluate", *SHARDS, "--output", str(folder / "shards")]) == 0
    assert run_command([*REPRODUCE, "--output", str(folder / "reproduction")]) == 0
    return folder


REPRODUCE = ("reproduce", "learning-low", "--episodes", "20")
SHARDS = ("--agents", "coast", "--episodes", "20", "--shards", "2")


STUDIES: dict[str, Callable[[Callable[[str], Any]], Study]] = {
    "shards": lambda get: Study(
        ("evaluate", *SHARDS),
        get("done") / "shards",
        ("evaluate", *SHARDS, "--seed", "8"),
        "holds shards with other settings (seed 7, here 8)",
        "question.json",
    ),
    "reproduction": lambda get: Study(
        REPRODUCE, get("done") / "reproduction", (*REPRODUCE, "--episodes", "50"), "(episodes 20, here 50)",
        "reproduction.json",
    ),
    "ablation": lambda get: Study(
        ("study", "ablate", "--recipes", get("tiny_total"), *ABLATE),
        get("finished_ablation"),
        ("study", "ablate", "--recipes", get("tiny_total"), *ABLATE, "--budget", "60", "--seeds", "3"),
        "(seeds 2, here 3; budget 50, here 60)",
        "settings.json",
    ),
    "tuning": lambda get: Study(
        ("study", "tune", get("finished_tuning").parent / "tuning.yaml", "--trials", TRIALS),
        get("finished_tuning"),
        ("study", "tune", get("write_tuning")(seed=1), "--trials", TRIALS),
        "holds a tuning with other settings",
        "tuning.json",
    ),
    "sweep": lambda get: Study(
        ("study", "sweep", get("finished_sweep").parent / "sweep.yaml", "--jobs", "1"), get("finished_sweep")
    ),
}  # fmt: skip


@pytest.fixture(params=STUDIES)
def study(request: pytest.FixtureRequest) -> Study:
    """Each of them."""
    return STUDIES[request.param](request.getfixturevalue)


def files_in(folder: Path, but: str) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != but}


@pytest.fixture
def told(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Call it with a folder, a command line and its exit status: what it says; the folder stays as it is.

    Files named ``but`` may change.
    """

    def call(folder: Path, *line: object, status: int = 2, but: str = "") -> str:
        before = files_in(folder, but)
        capsys.readouterr()
        assert run_command([*map(str, line), "--output", str(folder)]) == status
        assert files_in(folder, but) == before
        return "\n".join(capsys.readouterr())

    return call


def test_other_settings__are_refused_with_what_differs(study: Study, told) -> None:
    assert not study.other or study.told in told(study.folder, *study.other)


def test_folder_of_something_else__is_left_alone(study: Study, told, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("years of work")
    assert "is a file; give a folder" in told(tmp_path / "mine" / "thesis.tex", *study.line)
    if study.line[0] != "study":  # a study's own files stand beside what is there
        assert "holds no" in told(tmp_path / "mine", *study.line)


def test_second_process__is_refused(study: Study, told, tmp_path: Path) -> None:
    shutil.copytree(study.folder, tmp_path / "copy")
    if study.line[0] == "evaluate":  # which looks at what is finished first
        (tmp_path / "copy" / "journal.jsonl").unlink()
    with FileLock(tmp_path / "copy" / ".lock"):
        assert "another process works in it" in told(tmp_path / "copy", *study.line)


def test_damaged_record__is_named(study: Study, told, tmp_path: Path) -> None:
    if study.record:
        shutil.copytree(study.folder, tmp_path / "copy")
        (tmp_path / "copy" / study.record).write_text("[]")
        assert f"{study.record}: is damaged" in told(tmp_path / "copy", *study.line)


LAST = "trainings/cooperation-3-congested-tiny-shared-seed1"


@pytest.mark.parametrize(
    ("study", "file", "damage", "message"),
    [
        ("tuning", "tuning.json", ('"torch": "2.', '"torch": "1.'), "other settings (versions torch 1."),
        ("tuning", "study.journal", ('{"op_code":0', '{"op_kode":0'), "cannot be used"),
        ("tuning", "study.journal", ('{"op_code":0', "\x00"), "cannot be used"),
        ("tuning", "study.journal", ('"results":"[', '"results":"{'), "trial 0 is damaged"),
        ("tuning", "study.journal", ('"results":"[', '"results":7,"x":"['), "cannot be used"),
        ("ablation", f"{LAST}/run.json", ("{", "["), "run.json: is damaged"),
        ("ablation", f"{LAST}/config.json", ("{", "["), "config.json: is damaged"),
        (
            "ablation",
            f"{LAST}/config.json",
            ('"total_steps": 256', '"total_steps": 512'),
            "holds another training (here other: recipe total_steps); give another folder",
        ),
        ("ablation", f"{LAST}/run.json", None, "is no training"),
        ("ablation", f"{LAST}/team.json", ('"scheme"', '"shceme"'), "team.json"),
        ("ablation", f"{LAST}/policy/manifest.json", ("{", "{}"), "manifest.json"),
    ],
    indirect=["study"],
)
def test_damaged_file__is_named_in_one_line_before_anything_is_done(
    study: Study, file: str, damage: tuple[str, str] | None, message: str, told, tmp_path: Path
) -> None:
    """Of an ablation a joint optimum and a training are left to be made, which come before it."""
    damaged = Path(shutil.copytree(study.folder, tmp_path / "copy")) / file
    for other in (tmp_path / "copy" / "optimum", damaged.parents[1] / "cooperation-3-pair-tiny-shared-seed0"):
        shutil.rmtree(other, ignore_errors=True)
    text = damaged.read_text()
    damaged.unlink()
    if damage is not None:
        assert damage[0] in text
        damaged.write_text(text.replace(*damage))
    said = told(tmp_path / "copy", *study.line, but=damaged.name)
    assert message in said and said.count("\n") == 2


@pytest.mark.parametrize(
    ("study", "copied", "options", "patterns"),
    [
        (
            "ablation",
            True,
            ["--cost"],
            ["to do: 0 trainings, 0 decisions: 0 s; joint", "npz: is damaged; its worlds are"],
        ),
        ("ablation", True, ["--seeds", "3", "--cost"], ["to do: 2 trainings, 512 decisions at"]),
        ("ablation", False, ["--seeds", "1", "--cost"], ["to do: 2 trainings, 512 decisions at"]),
        ("sweep", True, ["--dry-run", "--json"], ['(?s)("state": "finished".*){4}', '"decisions_left": 0,']),
        (
            "sweep",
            False,
            ["--dry-run"],
            [
                r"^(new +paper-random-tiny-seed\d-\w+  gamma=\S+\n){4}",
                "seed3-.* gamma=0.9\n",
                "to do: 4 jobs, 1,024 dec",
            ],
        ),
        (
            "tuning",
            False,
            ["--dry-run", "--jobs", "2"],
            ["\nn_epochs  from 1 to 4, whole  \\(the recipe has 2\\)\n", f"{TRIALS} trials of 512 decisions: about"],
        ),
        ("tuning", False, ["--dry-run", "--json"], ['"n_epochs": 2,', r'"core_s_per_trial": (?!0\.0\b)\d']),
    ],
    indirect=["study"],
)
def test_cost__is_told_and_nothing_is_made(
    study: Study, copied: bool, options: list[str], patterns: list[str], told, tmp_path: Path
) -> None:
    folder = tmp_path / "there"
    if copied:
        shutil.copytree(study.folder, folder)
    for damaged in [*folder.glob("optimum/*/*.npz")][:1]:
        damaged.write_bytes(b"no table")
    said = told(folder, *study.line, *options, status=0)
    assert [each for each in patterns if not re.search(each, said)] == [] and folder.exists() == copied
