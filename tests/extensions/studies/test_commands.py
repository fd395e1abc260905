"""`ethbrake study falsify`: the worlds that it keeps, and code that it does not run."""

from pathlib import Path

import pytest

from ethbrake_marl.extensions.studies.named_worlds import NamedWorlds
from tests.cli.test_printed import check_story
from tests.files.test_files import check_target
from tests.fixtures.commands import Command, Refuse, check_refused, told_json

pytestmark = pytest.mark.usefixtures("empty_folder")


EVIL = """from pathlib import Path
import ethbrake_marl.first_edition as eb
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
    ("--budget 0", "--budget"),
    ("--budget 10 --output worst.txt", "must end in .yaml"),
    ("--budget 10 --measure bound", "has no shield"),
    ("--budget 10 --measure difference", "--against AGENT"),
    ("--against coast --budget 10", "listed twice"),
    ("--measure harm --against coast --budget 10", "uses no second agent"),
    ("--budget 10 --measure hram", "did you mean 'harm'?"),
    ("--agent ppo@nowhere --budget 10", "nowhere: is not a folder"),
    ("--budget 10 --scenario mixture-delays", "is a mixture"),
    ("--budget 10 --scenario cooperation-2-blocked", "has delays and losses"),
    ("--budget 10 --scenario paper-scenario-1", "no quantity is random"),
    ("--agent ladder --measure harm --budget 8", "means several agents"),
    ("--budget 100000 --output there.yaml", "there.yaml: already exists"),
]


@pytest.mark.parametrize(("options", "key"), FALSIFIED)
def test_falsify__is_refused(options: str, key: str, refuse: Refuse) -> None:
    Path("there.yaml").write_text("precious")
    refuse(f"study falsify {'' if '--agent' in options.split() else '--agent coast '}{options}", key)


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        ("scenario: paper-random", "scenario: paper-distance", "has changed since these worlds were found"),
        ("harm_count: first", "harm_count: second", "line 8: harm_count"),
        ("    score: 120", "    skore: 120", "did you mean score?"),
        ("name: regret-2", "name: regret-1", "two worlds have the name 'regret-1'"),
        ("{gap_1_m: 9.9251", "{gap_3_m: 9.9251", "different keys"),
        ("version: 1", "version: 2", "line 2: version = 2"),
    ],
)
def test_worlds_that_were_found__are_refused_where_the_file_was_changed(
    old: str, new: str, key: str, refuse: Refuse
) -> None:
    text = STORY.read_text("utf-8").partition("$ cat worst.yaml\n")[2].partition("\n\n$ ")[0]
    assert text.count(old) == 1
    Path("worst.yaml").write_text(text.replace(old, new) + "\n")
    refuse("study falsify --again worst.yaml", key)


STORY = Path(__file__).parent / "printed" / "searches.txt"


def test_commands__print_what_is_listed(empty_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    check_story(STORY, monkeypatch)
