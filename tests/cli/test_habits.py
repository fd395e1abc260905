"""What people type at any command line: -h, --version, python -m, Tab; and why the first call takes longer."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core import event

from ethbrake_marl import __version__
from ethbrake_marl.cli import app as frame, command, doctor
from ethbrake_marl.cli.app import app, run_command
from ethbrake_marl.kernel_store import cache_folder
from ethbrake_marl.physics.compiling import compiled

ROOT = Path(__file__).resolve().parents[2]


def test_version__is_told_by_the_command_and_by_python_m(ethbrake):
    assert ethbrake("--version").out == f"ethbrake {__version__}\n"
    result = subprocess.run(
        [sys.executable, "-m", "ethbrake_marl", "--version"],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (result.returncode, result.stdout, result.stderr) == (0, f"ethbrake {__version__}\n", "")


def test_help__tells_the_parts_of_the_package_without_importing_them():
    assert command.part_names() == command.PARTS


COMPLETION = [
    ({"_ETHBRAKE_COMPLETE": "complete_bash", "COMP_WORDS": "ethbrake sce", "COMP_CWORD": "1"}, "scenario\n"),
    ({"_ETHBRAKE_COMPLETE": "complete_bash", "COMP_WORDS": "ethbrake scenario val", "COMP_CWORD": "2"}, "validate\n"),
    ({"_ETHBRAKE_COMPLETE": "complete_zsh", "_TYPER_COMPLETE_ARGS": "ethbrake doctor --comp"}, '"--compile"'),
]


@pytest.mark.parametrize(("asked", "found"), COMPLETION)
def test_completion__a_shell_that_asks_gets_what_can_follow(monkeypatch, capsys, asked, found):
    for name, value in asked.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit) as ended:
        run_command([])
    assert ended.value.code == 0
    assert found in capsys.readouterr().out


NOT_ASKED = [
    {"_ETHBRAKE_COMPLETE": "bash_source"},
    {"_ETHBRAKE_COMPLETE": "1"},
    {"_ETHBRAKE_COMPLETE": "complete_bash"},
    {"_ETHBRAKE_COMPLETE": "complete_bash", "COMP_WORDS": "ethbrake", "COMP_CWORD": "x"},
    {"_ETHBRAKE_COMPLETE": "complete_tcsh", "_TYPER_COMPLETE_ARGS": "ethbrake"},
]


@pytest.mark.parametrize("asked", NOT_ASKED)
def test_completion__a_variable_that_no_shell_set_changes_nothing(ethbrake, monkeypatch, asked):
    for name, value in asked.items():
        monkeypatch.setenv(name, value)
    assert ethbrake("--version").out == f"ethbrake {__version__}\n"


@pytest.mark.parametrize(
    ("loaded", "temporary", "told"),
    [
        ([], False, "compiling the physics, once: minutes of one core, then it is kept\n"),
        (["advance-1"], False, "compiling what was not used before, once, then it is kept\n"),
        ([], True, "no folder can be written"),
    ],
)
def test_first_compilation__is_told_once(tmp_path, monkeypatch, capsys, loaded, temporary, told):
    folder = tmp_path / ("ethbrake_marl-x" if temporary else "kept")
    folder.mkdir()
    monkeypatch.setattr("ethbrake_marl.kernel_store.cache_folder", lambda: folder)
    monkeypatch.setattr("ethbrake_marl.physics.compiling.cache_folder", lambda: folder)
    monkeypatch.setattr("ethbrake_marl.physics.compiling._loaded", loaded)
    monkeypatch.setattr("ethbrake_marl.kernel_store._tellers", [])
    monkeypatch.setitem(event._registered, "numba:compile", [])  # nobody listens any more after this test
    monkeypatch.setattr("warnings.showwarning", None)
    frame.prepare_streams()

    @compiled
    def next_number(x: int) -> int:
        return x + 1

    assert next_number(1) == 2
    assert next_number(1.5) == 2.5
    captured = capsys.readouterr()
    assert captured.out == "" and told in captured.err and captured.err.count("\n") == 1
    monkeypatch.setattr(frame, "EVERY_S", 0.0)
    assert next_number(1j) == 1 + 1j
    assert re.search(r"^compiling: \d+ kernels in \d+ s so far$", capsys.readouterr().err, re.MULTILINE)


def test_doctor__compiles_only_when_asked(ethbrake, monkeypatch):
    monkeypatch.setattr(doctor, "compile_ahead", lambda training: (True, "9 kernels ready"))
    assert "compile" not in ethbrake("doctor").out
    assert "9 kernels ready" in ethbrake("doctor", "--compile").out


def test_doctor_compile__tells_how_far_it_is_and_what_failed(ethbrake, monkeypatch):
    monkeypatch.setattr(doctor, "_call", lambda door, folder: "no luck" if "shield" in door else "")
    answer = ethbrake("doctor", "--compile")
    assert answer.status == 1 and re.search("FAIL +compile +shield failed: no luck", answer.out)
    *far, failed = [line for line in answer.err.splitlines() if line.startswith("compile: ")]
    assert re.fullmatch(r"compile: (\d+) of \1 commands done, \d+ files in the cache", far[-1])
    assert failed == "compile: shield failed: no luck"


def test_compile_ahead__for_a_run_alone_calls_one_command(monkeypatch, tmp_path):
    called = []
    monkeypatch.setattr(doctor, "_call", lambda door, folder: called.append(door) or "")
    assert doctor.compile_ahead(training=False, run_alone=True)[0]
    ((*_, agents),) = called
    assert set(agents.split(",")) >= {"full_brake", "e_v2x_bm", "e_v2x_bm:pairwise", "ppo@shipped+episode"}


def test_doctor_compile__where_nothing_can_be_kept_does_not_begin(ethbrake, monkeypatch):
    monkeypatch.setattr(doctor, "is_temporary", lambda folder: True)
    monkeypatch.setattr(doctor, "_call", None)
    answer = ethbrake("doctor", "--compile")
    assert answer.status == 1 and re.search("FAIL +compile +no folder .* NUMBA_CACHE_DIR", answer.out)


@pytest.mark.long
def test_doctor_compile__leaves_nothing_to_compile(ethbrake):
    answer = ethbrake("doctor", "--compile", "--json")
    assert answer.status == 0 and '"name": "compile",\n    "ok": true' in answer.out
    kernels = set(cache_folder().iterdir())
    commands = [
        ("evaluate", "--agents", "full_brake,e_v2x_bm,ppo@shipped,ppo@shipped+episode", "--episodes", "3"),
        ("shield", "--agents", "full_brake", "--episodes", "3"),
        ("evaluate", "--agents", "planner,full_brake+step", "--episodes", "3"),
    ]
    assert [ethbrake(*command).status for command in commands] == [0, 0, 0]
    assert set(cache_folder().iterdir()) == kernels


def test_results__stand_alone_on_stdout_whatever_a_file_of_the_users_prints(ethbrake, tmp_path: Path) -> None:
    (tmp_path / "noise.py").write_text('print("noise of a plug-in")\n')
    (tmp_path / "mine.py").write_text(
        "import numpy as np, ethbrake_marl as eb\n"
        "def act(seen):\n"
        '    print("noise of a policy")\n'
        "    return np.full((len(seen), 1), -1.0)\n"
        "def make(): return eb.policy_agent(act)\n"
    )
    files = ["--plugin", tmp_path / "noise.py", "--agents", f"full_brake,{tmp_path}/mine.py:make"]
    told = ethbrake("evaluate", *files, "--episodes", "3", "--json")
    assert told.status == 0 and len(json.loads(told.out)) == 2
    assert "noise of a plug-in" in told.err and "noise of a policy" in told.err
    table = ethbrake("evaluate", *files, "--episodes", "3")
    assert "noise" not in table.out and "full_brake" in table.out


def test_a_command_of_a_plug_in__prints_where_it_likes(ethbrake, tmp_path: Path) -> None:
    app.command("my-words")(lambda: print("words"))
    try:
        assert ethbrake("my-words").out == "words\n"
    finally:
        app.registered_commands.pop()
