"""Every program of the repository has options that it can show, and takes no unknown one for the name of a file."""

import ast
import runpy
import sys
from pathlib import Path

import pytest

from ethbrake_marl.errors import MissingExtra

ROOT = Path(__file__).resolve().parents[2]
FOLDERS = ("docs", "docs/studies", "tests", "train")


def is_program(file: Path) -> bool:
    """Whether a file does something when it is run: it has a guard, or is a study."""
    text, guard = file.read_text("utf-8"), '__name__ == "__main__"'
    statements = ast.parse(text).body if guard in text.replace("'", '"') else []
    guarded = any(
        isinstance(each, ast.If) and ast.unparse(each.test) == "__name__ == '__main__'" for each in statements
    )
    return guarded or file.parent == ROOT / "docs" / "studies"


FILES = {file for folder in FOLDERS for file in (ROOT / folder).glob("**/*.py" if folder == "tests" else "*.py")}
PROGRAMS = sorted(str(file.relative_to(ROOT)) for file in FILES if is_program(file))


@pytest.mark.parametrize("program", PROGRAMS)
def test_program__refuses_an_unknown_option_with_its_help(program, empty_folder, monkeypatch, capsys) -> None:
    monkeypatch.setattr(sys, "argv", [program, "--frobnicate"])
    monkeypatch.setattr(sys, "path", [str((ROOT / program).parent), *sys.path])
    try:
        runpy.run_path(str(ROOT / program), run_name="__main__")
    except (MissingExtra, ModuleNotFoundError) as error:
        pytest.skip(str(error))
    except SystemExit as end:
        assert end.code == 2
    else:
        pytest.fail("the program ran")
    told = capsys.readouterr()
    assert told.out + told.err
    assert not [*empty_folder.iterdir()]


def test_programs__are_all_found() -> None:
    assert {"docs/studies/regimes.py", "tests/fixtures/recordings.py", "tests/docs/layout.py"} <= {*PROGRAMS}
    assert len(PROGRAMS) > 26
