"""`ethbrake study falsify`: the worlds that it keeps, and code that it does not run."""

from pathlib import Path

import pytest

from ethbrake_marl.extensions.studies.named_worlds import NamedWorlds
from tests.cli.test_printed import check_story
from tests.files.test_files import check_target
from tests.fixtures.commands import Command, Refuse, check_refused, told_json

pytestmark = pytest.mark.usefixtures("empty_folder")


EVIL = """from pathlib import Path
import ethbrake_marl as eb
Path("ran").touch()
def make():
    return eb.make_agent("coast")
"""


def test_again__runs_no_code_that_only_a_file_names(ethbrake: Command) -> None:
    Path("mine.py").write_text(EVIL)
    found = ("study", "falsify", "--agent", "coast", "--against", "full_brake", "--budget", "64")
    assert ethbrake(*found, "--output", "worst.yaml").status == 0
    whole = Path("worst.yaml").read_text()
    for line in ("agent: coast\n", "against: full_brake\n"):
        Path("worst.yaml").write_text(whole.replace(line, f'{line.partition(" ")[0]} "mine.py:make"\n'))
        check_refused(ethbrake("study", "falsify", "--again", "worst.yaml"), "does not run code")
    assert not Path("ran").exists()


def test_falsify__as_many_worlds_as_it_keeps_read_back(ethbrake: Command) -> None:
    words = ("--agent", "full_brake", "--measure", "harm", "--scenario", "stress-wide", "--keep", "200")
    words += ("--budget", "512", "--output", "many.yaml", "--json")
    told, kept = told_json(ethbrake("study", "falsify", *words)), NamedWorlds.read(Path("many.yaml")).worlds
    assert told["worlds"] == [world.model_dump(exclude_none=True) for world in kept] and len(kept) == 200
    assert Path("many.yaml").stat().st_size > 64 << 10


def test_target__that_cannot_be_replaced_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    check_target("study falsify --agent coast --output", tmp_path / "mine.yaml", monkeypatch, capsys)


FALSIFIED = [
    ("study falsify --agent coast --budget 0", "Invalid value for '--budget': must be greater than or equal to 1 (see"),
    (
        "study falsify --agent coast --budget 10 --output worst.txt",
        "worst.txt: the name of a file with worlds must end in .yaml or .yml",
    ),
    (
        "study falsify --agent coast --budget 10 --measure bound",
        "agent 'coast' has no shield, but --measure bound compares the harm with the",
    ),
    (
        "study falsify --agent coast --budget 10 --measure difference",
        "--measure difference compares two agents; give the second agent with --against AGENT",
    ),
    ("study falsify --agent coast --against coast --budget 10", "agent 'coast' is listed twice; list each agent once"),
    (
        "study falsify --agent full_brake --measure harm --against coast --budget 10",
        "--against coast: --measure harm uses no second agent; leave --against out",
    ),
    ("study falsify --agent coast --budget 10 --measure hram", "unknown measure 'hram'; did you mean 'harm'?"),
    (
        "study falsify --agent ppo@nowhere --budget 10",
        "nowhere: is not a folder; give the folder of a policy bundle (manifest.json, weights.safetensors)",
    ),
    (
        "study falsify --agent coast --budget 10 --scenario mixture-delays",
        "scenario 'mixture-delays': is a mixture; use one of its scenarios: paper-delay-low",
    ),
    (
        "study falsify --agent coast --budget 10 --scenario cooperation-2-blocked",
        "scenario 'cooperation-2-blocked': its v2x channel has delays and losses, which a table",
    ),
    (
        "study falsify --agent coast --budget 10 --scenario paper-scenario-1",
        "scenario 'paper-scenario-1': no quantity is random, so all its worlds are the same",
    ),
    (
        "study falsify --agent ladder --measure harm --budget 8",
        "agent ladder: this name means several agents; give the name of one agent",
    ),
    ("study sweep nowhere.yaml --output new", "nowhere.yaml: the file does not exist"),
]


@pytest.mark.parametrize(("line", "message"), FALSIFIED, ids=lambda value: value[:60])
def test_study__is_refused(line: str, message: str, refuse: Refuse) -> None:
    refuse(line, message)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "scenario: paper-random",
            "scenario: paper-distance",
            "scenario 'paper-distance' has changed since these worlds were found",
        ),
        ("harm_count: first", "harm_count: second", "worst.yaml, line 8: harm_count = second: must be first or total"),
        ("    score: 120", "    skore: 120", "worst.yaml, line 12: worlds[0].skore: unknown key; did you mean score?"),
        (
            "name: regret-2",
            "name: regret-1",
            "worst.yaml: two worlds have the name 'regret-1'; give each world a different name",
        ),
        ("{gap_1_m: 9.9251", "{gap_3_m: 9.9251", "worlds[1].state and worlds[0].state have different keys"),
        ("version: 1", "version: 2", "worst.yaml, line 2: version = 2: must be less than or equal to 1"),
    ],
)
def test_worlds_that_were_found__are_refused_where_the_file_was_changed(
    old: str, new: str, message: str, refuse: Refuse
) -> None:
    story = STORY.read_text("utf-8")
    text = story.partition("$ cat worst.yaml\n")[2].partition("\n\n$ ")[0]
    assert text.count(old) == 1
    Path("worst.yaml").write_text(text.replace(old, new) + "\n")
    refuse("study falsify --again worst.yaml", message)


SWEEP = "grid: {scenario: paper-random, recipe: %s}"
TUNING = "scenario: paper-random\nrecipe: ppo\nsearch: {%s: {low: 1, high: 4}}\n"


@pytest.mark.parametrize(
    ("plan", "line", "message"),
    [
        (
            SWEEP % "pppo",
            "sweep",
            "plan.yaml, line 1: grid (paper-random, pppo, seed 0): unknown recipe 'pppo'; did you mean",
        ),
        (SWEEP % "ppo", "sweep --jobs 0", "Invalid value for '--jobs': must be greater than or equal to 1"),
        (SWEEP % "ppo", "sweep --retries -1", "Invalid value for '--retries': must be greater than or equal to 0"),
        (TUNING % "n_epoch", "tune", "plan.yaml, line 3: unknown setting 'n_epoch'; did you mean 'n_epochs'?"),
        (TUNING % "n_epochs", "tune --trials 0", "Invalid value for '--trials': must be greater than or equal to 1"),
        (
            TUNING % "n_epochs",
            "tune --export best.txt",
            "--export best.txt: the file name of a recipe must end in .yaml",
        ),
        (TUNING % "n_epochs", "tune --export 'Best One.yaml'", "recipe name 'Best One': must be 1 to 64 lower case"),
        (
            TUNING % "n_epochs",
            "tune --export plan.yaml",
            "plan.yaml: already exists; give another name, or pass force=True (--force) to overwrite the file",
        ),
    ],
    ids=lambda value: value[:30],
)
def test_plan_of_a_study__is_refused(plan: str, line: str, message: str, refuse: Refuse) -> None:
    Path("plan.yaml").write_text(plan)
    command, *options = line.split(" ", 1)
    refuse(" ".join(["study", command, "plan.yaml", "--output", "new", *options]), message)


def test_file_of_worlds__that_is_there_is_not_replaced_unasked(refuse: Refuse) -> None:
    Path("worst.yaml").write_text("precious")
    line = "study falsify --agent coast --budget 100000 --output worst.yaml"
    refuse(line, "worst.yaml: already exists; give another name, or pass force=True (--force) to overwrite the file")


STORY = Path(__file__).parent / "printed" / "searches.txt"


def test_commands__print_what_is_listed(empty_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check_story(STORY, monkeypatch)
