"""Only plain files are read, and never more of them than is expected, or replaced; refusals: ``refusals/files.txt``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.store import read_plain, write_output
from ethbrake_marl.scenario import Scenario


def test_plain_file__is_read_up_to_the_limit(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"12345678")
    (tmp_path / "link").symlink_to("a")
    assert [read_plain(tmp_path / name, 8) for name in ("a", "link")] == [b"12345678"] * 2


def test_pipe_and_device__are_not_even_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "pipe")
    monkeypatch.setattr("os.open", lambda *args: pytest.fail("opened"))
    for path in (tmp_path / "pipe", Path("/dev/zero"), Path("/dev/tty")):
        with pytest.raises(InvalidInput, match=r"is not a plain file but a device, a pipe or a socket"):
            read_plain(path, 8)


def test_plain_file__is_looked_at_again_once_it_is_open_and_while_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"1" * 99)
    small = os.stat_result((0o100644, *([0] * 9)))
    monkeypatch.setattr("os.stat", lambda *args, **kwargs: small)
    with monkeypatch.context() as growing, pytest.raises(InvalidInput, match=r"larger than"):
        growing.setattr("os.fstat", lambda *args, **kwargs: small)
        read_plain(path, 8)
    path.unlink()
    os.mkfifo(path)
    with pytest.raises(InvalidInput, match=r"is not a plain file but a device, a pipe"):
        read_plain(path, 8)


def test_write__replaces_a_plain_file_by_force_and_takes_the_longest_name(tmp_path: Path) -> None:
    path = tmp_path / ("a" * 255)
    for content, force in ((b"old", False), (b"new", True)):
        write_output(path, content, force=force)
        assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [(path.name, content)]


@pytest.mark.parametrize(
    ("words", "ending"),
    [
        ("evaluate --agents coast --per-world", "csv"),
        ("evaluate --agents coast --report", "html"),
        ("search best-harm --output", "npz"),
        ("search falsify --agent coast --output", "yaml"),
        ("watch picture criticality --output", "png"),
        ("watch record --agents coast --output", "svg"),
        ("watch dataset --format parquet --agents coast --output", "parquet"),
    ],
)
def test_target__that_cannot_be_replaced_is_refused_before_any_work(
    words: str, ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    one = Scenario.sample  # by which a scenario is tried

    def sample(scenario: Scenario, n: int, *given: Any, **how: Any) -> Any:
        assert n == 1, "worlds were drawn"
        return one(scenario, n, *given, **how)

    monkeypatch.setattr(Scenario, "sample", sample)
    path = tmp_path / f"mine.{ending}"
    path.symlink_to("nowhere")
    assert run_command([*words.split(), str(path), "--force"]) == 2
    assert capsys.readouterr().err == f"ethbrake: error: {path}: is a symbolic link; give the file it points to\n"
    assert not (tmp_path / "nowhere").exists()
