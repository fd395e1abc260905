"""Only plain files are read, and never more of them than is expected."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from ethbrake_marl.errors import CorruptBundle, InvalidInput
from ethbrake_marl.files.store import read_plain


def test_plain_file__is_read_up_to_the_limit(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"12345678")
    assert read_plain(path, 8) == b"12345678"
    with pytest.raises(InvalidInput, match=r"a: larger than 0 KiB"):
        read_plain(path, 7)
    (tmp_path / "link").symlink_to("a")
    assert read_plain(tmp_path / "link", 8) == b"12345678"
    with pytest.raises(CorruptBundle, match=r"link: is a symbolic link"):
        read_plain(tmp_path / "link", 8, refusal=CorruptBundle, follow_links=False)


def test_pipe_and_device__are_not_even_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "pipe")
    monkeypatch.setattr("os.open", lambda *args: pytest.fail("opened"))
    for path in (tmp_path / "pipe", Path("/dev/zero"), Path("/dev/tty")):
        with pytest.raises(InvalidInput, match=r"is not a plain file but a device, a pipe or a socket"):
            read_plain(path, 8)
    with pytest.raises(InvalidInput, match=r"is not a plain file but a folder"):
        read_plain(tmp_path, 8)


def test_what_takes_the_place_of_a_file__is_looked_at_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"1")
    right = os.stat(path)
    path.unlink()
    os.mkfifo(path)
    monkeypatch.setattr("os.stat", lambda *args, **kwargs: right)
    with pytest.raises(InvalidInput, match=r"is not a plain file but a device, a pipe"):
        read_plain(path, 8)


def test_file__that_grows_while_it_is_read_is_too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"1" * 99)
    small = os.stat_result((0o100644, *([0] * 9)))
    monkeypatch.setattr("os.stat", lambda *args, **kwargs: small)
    monkeypatch.setattr("os.fstat", lambda *args, **kwargs: small)
    with pytest.raises(InvalidInput, match=r"larger than"):
        read_plain(path, 8)


@pytest.mark.parametrize("name", ["none", "a\0b", "x" * 5000, "loop", "dangling", "file/below"])
def test_what_cannot_be_opened__is_one_error(tmp_path: Path, name: str) -> None:
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "dangling").symlink_to("nowhere")
    (tmp_path / "file").touch()
    with pytest.raises(InvalidInput, match=r"no such file|cannot be read"):
        read_plain(tmp_path / name, 8)
