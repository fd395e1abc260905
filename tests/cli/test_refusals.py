"""What command lines refuse: one line on stderr, nothing on stdout, exit status 2, and no file touched."""

from pathlib import Path

import pytest

from ethbrake_marl.worlds.catalogue import scenario_path
from tests.fixtures.commands import Refuse

USAGE = [
    ("", "Missing command. (see: ethbrake --help)"),
    ("evalute", "No such command 'evalute'. Did you mean 'evaluate'? (see: ethbrake --help)"),
    (
        "evaluate --frobnicate",
        "No such option: --frobnicate (Possible options: --force) (see: ethbrake evaluate --help)",
    ),
    (
        "evaluate --per-world parquet --output new",
        "Invalid value for '--per-world': 'parquet' is not one of 'csv'. (see",
    ),
]


@pytest.mark.parametrize(("line", "message"), USAGE, ids=lambda value: value[:60])
def test_usage__is_refused_with_where_help_is(line: str, message: str, refuse: Refuse) -> None:
    refuse(line, message)


SCENARIOS = [
    ("scenario new mine --output /proc", "/proc/mine.yaml: cannot be written (No such file or directory)"),
    (
        "scenario sample paper-random --output x.txt",
        "x.txt: the name of a file with worlds must end in .csv or .png or .svg",
    ),
]


@pytest.mark.parametrize(("line", "message"), SCENARIOS, ids=lambda value: value[:60])
def test_scenario_command__is_refused(line: str, message: str, refuse: Refuse) -> None:
    refuse(line, message)


EVALUATIONS = [
    ("evaluate --set harm_count=both", "harm_count = 'both': must be 'first', 'total' or 'honest'"),
    ("evaluate --set rules=paper", "--set rules=paper: rules has ended; write --set harm_count=first"),
    (
        "train --set recipe.reward.harm_count=total --set harm_count=first",
        "--set harm_count: sets reward.harm_count, which --set recipe.reward.harm_count sets, too; leave one of them",
    ),
    (
        "run --set reward=honest --set harm_count=first",
        "--set harm_count: sets reward.harm_count, which --set reward sets",
    ),
    ("scenario sample paper-random --set rules=paper", "unknown setting 'rules'"),
    ("train --set observation=own", "--set observation: both scenario and recipe have this key; write scenario."),
    ("evaluate --output /proc/out", "/proc/out: cannot be written to (No such file or directory)"),
    ("evaluate --per-world csv", "--per-world: needs a folder for its file; add --output FOLDER"),
]


@pytest.mark.parametrize(("line", "message"), EVALUATIONS, ids=lambda value: value[:60])
def test_evaluation__is_refused(line: str, message: str, refuse: Refuse) -> None:
    refuse(line, message)


TRAININGS = [
    (
        "train --scenario cooperation-3-pair --set scheme=single --output no",
        "scheme single: scenario 'cooperation-3-pair' has 2 learners; use the scheme shared, independent or",
    ),
    ("train --resume .", ".: is not the folder of a run; name the folder of a run, for instance"),
]


@pytest.mark.parametrize(("line", "message"), TRAININGS, ids=lambda value: value[:60])
def test_run_training_export_shield_or_film__is_refused(line: str, message: str, refuse: Refuse) -> None:
    refuse(line, message)


def write_scenario(old: str, new: str) -> None:
    text = scenario_path("paper-random").read_text("utf-8").replace("name: paper-random", "name: mine")
    text = text.replace("early_impacts: reject", "early_impacts: keep")
    assert text.count(old) == 1
    Path("mine.yaml").write_text(text.replace(old, new))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [("\nmass_t: ", "\nmass_kg: ", "mine.yaml, line 12: mass_kg: unknown key; did you mean mass_t (tonnes)?")],
)
def test_validate__names_the_line_of_the_mistake(old: str, new: str, message: str, refuse: Refuse) -> None:
    write_scenario(old, new)
    refuse("scenario validate mine.yaml", message)


@pytest.mark.parametrize("command", ["run --output new", "evaluate"])
def test_role_that_cannot_drive__is_refused_before_anything_is_written(command: str, refuse: Refuse) -> None:
    write_scenario("vehicle_1: full_brake", "vehicle_1: coast:4")
    refuse(f"{command} --scenario mine.yaml", "mine.yaml, line 28: roles.vehicle_1 = coast:4: agent 'coast:4'")


def test_run__needs_a_learner(refuse: Refuse) -> None:
    write_scenario("vehicle_2: learner", "vehicle_2: full_brake")
    refuse("run --output new --scenario mine.yaml", "has no learner that the agents could drive")


@pytest.mark.parametrize(
    ("file", "line"),
    [("mine.yaml", "scenario new mine"), ("worlds.csv", "scenario sample paper-random --output worlds.csv")],
)
def test_file_that_is_there__is_not_replaced_unasked(file: str, line: str, refuse: Refuse) -> None:
    Path(file).parent.mkdir(exist_ok=True)
    Path(file).write_text("precious")
    refuse(line, f"{file}: already exists; give another name, or pass force=True (--force) to overwrite the file")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("run --output file/x", "file/x: file is not a folder; give a new folder"),
        ("train --output . --force", ".: already exists and is not the folder of a run; choose another name"),
    ],
)
def test_output__is_a_folder_of_its_own(line: str, message: str, refuse: Refuse) -> None:
    Path("file").write_text("precious")
    refuse(line, message)


@pytest.mark.parametrize(
    ("code", "line", "message"),
    [
        ("x = 1\nraise KeyError('secret')\n", "--agents bad.py:make", "file 'bad.py', line 2: KeyError: 'secret'"),
        (
            "import ethbrake_marl as eb\neb.make_agent('bad.py:make')\n",
            "--agents bad.py:make",
            "file 'bad.py', line 2: file 'bad.py': does not define 'make'",
        ),
        (
            "worst = 3\n",
            "--set measures=bad.py:worst",
            "file 'bad.py': measure 'worst': give one function, of(game, alert, last) or watch(game, alert), with a",
        ),
        (
            "import ethbrake_marl as eb\ndef slow(): return eb.policy_agent(lambda seen: exit(0))\n",
            "--agents bad.py:slow --episodes 3",
            "your own code ended the process: SystemExit: 0",
        ),
    ],
)
def test_file_of_the_user__is_refused_with_its_line(code: str, line: str, message: str, refuse: Refuse) -> None:
    Path("bad.py").write_text(code)
    refuse(f"evaluate {line}", message)
