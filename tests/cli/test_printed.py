"""What commands print, byte for byte, as listed in ``tests/cli/printed/story.txt``: one story in one folder.

Below a command line stand its stdout, its stderr behind ``! ``, and its exit status unless it is 0; progress
(``500 of 2,000``) is left out. ``$ cat FILE`` shows a file, ``$ sed -i`` changes one, ``$ rm`` removes one. ``HERE``
and ``ROOT`` stand for folders. With ``ETHBRAKE_SNAPSHOTS=write`` the test writes what is printed today: read the
difference. What extensions add is hidden here; tests/extensions/printed shows it.
"""

import contextlib
import io
import re
import shlex
import subprocess
from pathlib import Path

import pytest

from ethbrake_marl.cli.app import run_command
from tests.fixtures.snapshots import check_snapshot

ROOT = Path(__file__).resolve().parents[2]
STORY = Path(__file__).parent / "printed" / "story.txt"
PROGRESS = re.compile(r"^.*: [\d,]+ of [\d,]+(, about .* left)?\n", re.MULTILINE)


def printed(line: str) -> str:
    words, out, err = shlex.split(line), io.StringIO(), io.StringIO()
    if words[0] in ("cat", "rm", "sed"):
        return subprocess.run(words, check=True, capture_output=True, encoding="utf-8").stdout
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = run_command(words[1:])
    told = "".join(f"! {each}\n" for each in PROGRESS.sub("", err.getvalue()).splitlines())
    shown = out.getvalue() + told + (f"(status {status})\n" if status else "")
    return re.sub(r"[ ]+$", "", shown, flags=re.MULTILINE).replace(str(Path().resolve()), "HERE")


def told_again(story: Path) -> str:
    parts = re.split(r"^\$ (.*)\n", story.read_text("utf-8"), flags=re.MULTILINE)
    return parts[0] + "\n".join(f"$ {line}\n{printed(line)}" for line in parts[1::2]).replace(str(ROOT), "ROOT")


@pytest.mark.usefixtures("core_alone", "empty_folder")
def test_commands__print_what_is_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    check_story(STORY, monkeypatch)


def check_story(story: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "120")
    check_snapshot(story, told_again(story))
