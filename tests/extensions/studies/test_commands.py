"""`ethbrake study falsify`: the worlds that it keeps, and code that it does not run."""

from pathlib import Path

import pytest

from ethbrake_marl.extensions.studies.named_worlds import NamedWorlds
from tests.files.test_files import check_target
from tests.fixtures.commands import Command, check_refused, told_json

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
        check_refused(ethbrake("study", "falsify", "--again", "worst.yaml"), "is code")
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
