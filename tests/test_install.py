"""`.ci/install` with a python and a uv that only write down what they were asked."""

import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
TOLD = "UV_DEFAULT_INDEX", "UV_INDEX", "UV_FIND_LINKS", "SSL_CERT_FILE", "UV_INDEX_STRATEGY"
PYTHON = """#!/bin/sh
case "$*" in *"config list"*) cat "${0%/*}/settings"; exit ;; esac
echo "pip ${*#*install }" >>"${0%/*}/asked"
case "$*" in *" uv") exit "$PIP_HAS_NO_UV" ;; esac
"""
UV = """#!/bin/sh
[ "$1" = --version ] && exit "$NO_UV"
echo "uv ${*#*constraints.txt }" >>"${0%/*}/asked"
env | grep -E '^(UV_|SSL_)' >"${0%/*}/variables"
case "$*" in *"$UV_FAILS"*) echo "error: no route" >&2; exit 1 ;; esac
"""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """An environment whose name holds a blank."""
    folder = tmp_path / "an environment" / "bin"
    folder.mkdir(parents=True)
    for name, text in (("python", PYTHON), ("uv", UV)):
        (folder / name).write_text(text)
        (folder / name).chmod(0o755)
    (folder / "settings").touch()
    return folder


def install(place: Path, *arguments: str, **variables: str) -> tuple[list[str], str]:
    """What python and uv were asked to install, in this order, and stderr with stdout; the status is 0."""
    standard = {"PATH": "/usr/bin:/bin", "NO_UV": "0", "PIP_HAS_NO_UV": "1", "UV_FAILS": "nothing like it"}
    done = subprocess.run(
        ["/bin/sh", ROOT / ".ci" / "install", place.parent, *arguments],
        cwd=place, env=standard | variables, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return (place / "asked").read_text().splitlines(), done.stderr + done.stdout


def variables_of(place: Path) -> dict[str, str]:
    lines = (place / "variables").read_text().splitlines()
    return {name: value for name, _, value in (line.partition("=") for line in lines) if name in TOLD}


def test_settings_of_pip__are_handed_on_to_uv_without_what_is_missing_or_uv_has_itself(
    place: Path, tmp_path: Path
) -> None:
    (tmp_path / "wheels").mkdir()
    (place / "settings").write_text(
        f"global.extra-index-url='\\nhttps://one/simple\\nfile://{tmp_path}/wheels\\nfile:///none/simple'\n"
        f"global.find-links='/none'\n:env:.find-links='{tmp_path}/wheels /none {tmp_path}'\n"
        f"global.index-url='https://two/simple'\nglobal.timeout='9'\nglobal.cert='{tmp_path}/wheels'\n"
    )
    asked, told = install(place, "-e", ".[train]")
    found = {
        "UV_DEFAULT_INDEX": "https://two/simple",
        "UV_INDEX": f"https://one/simple file://{tmp_path}/wheels",
        "UV_FIND_LINKS": f"{tmp_path}/wheels,{tmp_path}",
        "SSL_CERT_FILE": f"{tmp_path}/wheels",
        "UV_INDEX_STRATEGY": "unsafe-best-match",
    }
    assert (asked, variables_of(place)) == (["uv -e .[train]"], found)
    assert "extra-index-url of pip's settings: file:///none/simple is neither a file nor a directory, and left" in told
    own = {"UV_DEFAULT_INDEX": "https://uv/simple", "UV_INDEX_STRATEGY": "first-index"}
    install(place, "-e", ".", **own)
    assert variables_of(place) == found | own


def test_no_uv__is_brought_by_pip_or_pip_installs_as_where_uv_fails(place: Path) -> None:
    asked, told = install(place, "-e", ".", NO_UV="1", PIP_HAS_NO_UV="0")
    assert (asked[0].endswith(" uv"), asked[1:], told) == (True, ["uv -e ."], "")
    (place / "asked").unlink()
    asked, told = install(place, "-e", ".", NO_UV="1")
    assert [line.partition("constraints.txt ")[2] for line in asked] == ["--quiet uv", "-e ."]
    assert told == "== no uv to be had (above): pip installs, which takes longer\n"
    (place / "asked").unlink()
    asked, told = install(place, "-e", ".", UV_FAILS="-e .")
    assert [line.partition(" ")[0] for line in asked] == ["uv", "pip"]
    assert told == "error: no route\n== uv could not (above): pip tries\n"


@pytest.mark.parametrize(
    ("index", "fails", "asked", "lines"),
    [
        ("", "nothing", ["uv --torch-backend auto --no-deps torch"], 0),
        ("", "--torch-backend", ["uv --torch-backend auto --no-deps torch", "uv --no-deps torch"], 1),
        ("https://torch/cpu", "", ["pip --quiet", "--no-deps --index-url https://torch/cpu torch"], 0),
    ],
)
def test_torch__is_the_build_for_this_machine_else_one_line_says_why(
    place: Path, index: str, fails: str, asked: list[str], lines: int
) -> None:
    found, told = install(place, "--torch", index, UV_FAILS=fails or "nothing")
    assert len(told.splitlines()) == lines
    assert found == asked if not index else all(part in found[0] for part in asked)
