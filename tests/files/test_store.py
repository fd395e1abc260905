"""Only plain files are read, and never more of them than is expected; refusals: ``refusals/files.txt``."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.store import read_plain


def test_plain_file__is_read_up_to_the_limit(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"12345678")
    (tmp_path / "link").symlink_to("a")
    assert [read_plain(tmp_path / name, 8) for name in ("a", "link")] == [b"12345678"] * 2
    with pytest.raises(InvalidInput, match=r"a\\x00b: cannot be read"):
        read_plain(tmp_path / "a\0b", 8)


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
