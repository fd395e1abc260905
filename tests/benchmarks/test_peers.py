"""``make bench-peers``: a peer that cannot be installed or measured is listed with the reason."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tests.benchmarks import peers
from tests.benchmarks.loops import LOOPS, OURS, Loop, rates


def interpreter(folder: Path, script: str) -> Path:
    """Something that is called like an interpreter of Python and does what ``script`` says."""
    path = folder / "python"
    path.write_text(f"#!/bin/sh\n{script}\n", "utf-8")
    path.chmod(0o755)
    return path


def test_loops__every_peer_stands_beside_one_of_ours() -> None:
    ours = {name for name, loop in LOOPS.items() if loop.distribution == OURS}
    assert ours and all((name in ours) == (loop.beside is None) for name, loop in LOOPS.items())
    assert {loop.beside for loop in LOOPS.values()} - {None} == ours


def test_rates__are_work_per_processor_second() -> None:
    slowest, fastest = rates(lambda: 1000, repetitions=2, seconds=0.001)
    assert 0.0 < slowest <= fastest


def test_install__tells_why_a_peer_cannot_be_had(tmp_path: Path) -> None:
    python = interpreter(tmp_path, 'echo "ERROR: no such thing: $*" >&2; echo hint >&2; exit 1')
    assert peers.install(python, "mpe2", "").startswith("ERROR: no such thing: -m pip install")
    assert peers.install(python, "vmas", "an-index-of-torch").startswith("torch: ERROR:")


def test_install__takes_torch_alone_and_from_its_index(tmp_path: Path) -> None:
    python = interpreter(tmp_path, f'echo "$*" >> {tmp_path}/asked')
    assert peers.install(python, "vmas", "an-index-of-torch") == ""
    first, second = (tmp_path / "asked").read_text("utf-8").splitlines()
    assert first.endswith("--no-deps --index-url an-index-of-torch torch")
    assert second.endswith("vmas") and "an-index-of-torch" not in second
    assert all(f"-c {file}" in first and file.is_file() for file in peers.CONSTRAINTS)


@pytest.mark.parametrize(
    ("script", "reason"),
    [
        ('echo "Traceback" >&2; echo "ModuleNotFoundError: no mpe2" >&2; exit 1', "ModuleNotFoundError: no mpe2"),
        ("exit 3", "ended with status 3"),
    ],
)
def test_measure__tells_why_it_failed(tmp_path: Path, script: str, reason: str) -> None:
    figure = peers.measure(interpreter(tmp_path, script), "mpe2")
    assert figure.reason == f"not measured: {reason}"
    assert peers.line(figure, {}).endswith(figure.reason)
    missing = peers.measure(tmp_path / "nowhere", "mpe2")
    assert "No such file" in missing.reason


def test_line__compares_with_ours_of_the_same_run(tmp_path: Path) -> None:
    python = interpreter(tmp_path, """echo '{"version": "1.1", "rates": [40, 50, 60]}'""")
    peer = peers.measure(python, "mpe2")
    ours = peers.Figure(Loop(OURS, "x", lambda: lambda: 1), "0.1", (900.0, 1000.0, 1100.0))
    assert peer.median == 50.0
    assert peers.line(peer, {"parallel": ours}).split()[-5:] == ["-", "60.0", "ours:", "20.0", "x"]
    assert "ours" not in peers.line(peer, {"parallel": peers.Figure(ours.loop, reason="not measured: why")})


@pytest.mark.parametrize(("value", "text"), [(6.944, "6.94"), (13.84, "13.8"), (99.96, "100"), (97_512.0, "97,500")])
def test_plain__has_three_digits(value: float, text: str) -> None:
    assert peers.plain(value) == text


def test_figures__are_of_this_interpreter_where_they_are_ours(monkeypatch, tmp_path, capsys) -> None:
    asked: list[tuple[Path, str]] = []

    def measured(python: Path, name: str) -> peers.Figure:
        asked.append((python, name))
        return peers.Figure(LOOPS[name], "1", (2.0,))

    other = tmp_path / "environment"
    (other / "bin").mkdir(parents=True)
    interpreter(other / "bin", "exit 0")
    monkeypatch.setattr(peers, "measure", measured)
    monkeypatch.setattr(peers, "install", lambda python, distribution, index: "no network" * (distribution == "mpe2"))
    monkeypatch.setattr(sys, "argv", ["peers", "--environment", str(other)])
    peers.main()
    assert dict((name, python) for python, name in asked) == {
        name: Path(sys.executable) if loop.distribution == OURS else other / "bin" / "python"
        for name, loop in LOOPS.items()
        if loop.distribution != "mpe2"
    }
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.endswith("not installed: no network") for line in lines) == 1
    assert sum("ours: 1.00 x" in line for line in lines) == 6
