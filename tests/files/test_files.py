"""Plain files that are read and replaced, YAML, and Python files of the user; refusals: ``test_refusals``."""

import errno
import math
import os
import stat
from pathlib import Path
from unittest.mock import Mock

import pytest
from hypothesis import given, settings, strategies as st

from ethbrake_marl.errors import AlreadyExists, InvalidInput, NoLocks
from ethbrake_marl.files.overrides import Override
from ethbrake_marl.files.plain import read_plain
from ethbrake_marl.files.python_file import files_run, load_from_file
from ethbrake_marl.files.store import (
    check_folder,
    hold_lock,
    new_folder,
    remove_folder,
    remove_unfinished,
    write_file,
    write_output,
)
from ethbrake_marl.files.yaml import DEPTH_LIMIT, YAML_SIZE_LIMIT, Document, flow_text, parse_yaml
from tests.refused import refused


def test_plain_file__is_read_up_to_the_limit(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"12345678")
    (tmp_path / "link").symlink_to("a")
    assert [read_plain(tmp_path / name, 8) for name in ("a", "link")] == [b"12345678"] * 2
    with refused("is larger than 0 KiB"):  # files of /proc say that they are empty
        read_plain("/proc/self/status", 8)


def test_write__replaces_a_plain_file_by_force_and_takes_the_longest_name(tmp_path: Path) -> None:
    path = tmp_path / ("a" * 255)
    for content, force in ((b"old", False), (b"new", True)):
        write_output(path, content, force=force)
        assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [(path.name, content)]
    plain = tmp_path / "plain"
    plain.touch()
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)  # as the user's umask says


def test_interrupted_write__leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_file(tmp_path / "a", b"old")
    monkeypatch.setattr("os.fsync", lambda descriptor: (_ for _ in ()).throw(KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        write_file(tmp_path / "a", b"new")
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("a", b"old")]


def test_folder__appears_whole_and_replaces_only_if_asked(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "run"

    def fill(text: str, *, replace: bool = False) -> None:
        with new_folder(path, replace=replace) as partial:
            (partial / "a").write_text(text)
            assert not path.exists() or (path / "a").read_text() == "old"
            if text == "failed":
                raise KeyError

    fill("old")
    with refused("already exists", AlreadyExists):
        fill("other")
    with pytest.raises(KeyError):
        fill("failed", replace=True)
    assert [*path.parent.iterdir()] == [path] and (path / "a").read_text() == "old"
    fill("new", replace=True)
    assert [*path.parent.iterdir()] == [path] and (path / "a").read_text() == "new"


def test_unfinished_files__of_killed_processes_are_removed(tmp_path: Path) -> None:
    (tmp_path / ".ethbrake-1.partial").mkdir()
    (tmp_path / ".ethbrake-2.partial").touch()
    (tmp_path / "mine.partial").touch()
    remove_unfinished(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.partial"]


def test_lock__is_held_by_one(tmp_path: Path) -> None:
    lock, busy = tmp_path / "lock", "somebody works here"
    with hold_lock(lock, busy), refused(busy), hold_lock(lock, busy):
        pytest.fail("held twice")
    with hold_lock(lock, busy):
        pass
    with refused("cannot be used as a lock"), hold_lock(tmp_path, "somebody works here"):
        pytest.fail("a folder was locked")


@pytest.mark.parametrize("number", [errno.ENOLCK])
def test_lock__on_a_file_system_without_locks_is_a_warning(number: int, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("fcntl.flock", Mock(side_effect=OSError(number, os.strerror(number))))
    for _ in range(2):
        with pytest.warns(NoLocks, match="no locks; run one process"), hold_lock(tmp_path / "lock", "busy"):
            pass


def test_folder__that_cannot_be_renamed_is_deleted_in_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path in ("old", "run", "new"):
        (tmp_path / path / "inside").mkdir(parents=True)
    rename = Path.rename
    crossing = OSError(errno.EXDEV, "Invalid cross-device link")
    monkeypatch.setattr(
        Path, "rename", lambda path, to: fail(crossing) if path.name in ("old", "run") else rename(path, to)
    )
    remove_folder(tmp_path / "old")
    with new_folder(tmp_path / "run", replace=True) as partial:
        (partial / "file").touch()
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")) == [
        "new",
        "new/inside",
        "run",
        "run/file",
    ]


def fail(error: OSError) -> None:
    raise error


def test_folder_for_files__takes_files_that_are_new_or_replaced_by_force(tmp_path: Path) -> None:
    (tmp_path / "old.csv").write_text("old")
    check_folder(tmp_path, ("new.csv",))
    check_folder(tmp_path / "new", ("old.csv",))
    check_folder(tmp_path, ("new.csv", "old.csv"), force=True)
    with refused("old.csv: already exists", AlreadyExists):
        check_folder(tmp_path, ("new.csv", "old.csv"))
    with refused("old.csv is not a folder; give a new folder"):
        check_folder(tmp_path / "old.csv" / "new")


# ---------------------------------------------------------------- YAML

SCALARS = {
    "1e3": 1000.0, ".5": 0.5, "12": 12, "0123": 123, "0x1F": 31,
    "true": True, "no": "no", "12:30": "12:30", "<<": "<<",
    "2024-01-01": "2024-01-01", "'1e3'": "1e3", '"true"': "true", "null": None, "": None,
    ".inf": math.inf, ".nan": math.nan,
}  # fmt: skip


@pytest.mark.parametrize("text", SCALARS)
def test_scalar__follows_the_core_schema_of_yaml_1_2(text: str) -> None:
    parsed = parse_yaml(f"key: {text}").content["key"]
    assert (repr(parsed), type(parsed)) == (repr(SCALARS[text]), type(SCALARS[text]))


def test_document__knows_the_line_of_each_value_or_of_what_is_around_it() -> None:
    found = parse_yaml("# mine\na:\n  b: [1,\n   2]\nc: 3\n", "my.yaml")
    assert found.content == {"a": {"b": [1, 2]}, "c": 3}
    lines = {("a",): 2, ("a", "b"): 3, ("a", "b", 0): 3, ("a", "b", 1): 4, ("c",): 5, ("a", "x"): 2, ("x",): 2}
    assert {path: found.where(path) for path in lines} == {k: f"my.yaml, line {line}" for k, line in lines.items()}
    assert Document("x", {}, {}).where(("a",)) == "x"
    with refused("my.yaml, line 4: too large"), found.refusing_at(("a", "b", 1)):
        raise InvalidInput("too large")


def test_document__shares_nothing_with_another_reader_of_the_same_text() -> None:
    parse_yaml("a: {b: [1]}").content["a"]["b"].append(2)
    assert parse_yaml("a: {b: [1]}").content == {"a": {"b": [1]}}


@pytest.mark.parametrize(("opening", "closing"), ["[]", ("{a: ", "}"), ("- ", "")])
def test_depth_and_size__the_limits_are_allowed(opening: str, closing: str) -> None:
    parse_yaml(opening * DEPTH_LIMIT + "1" + closing * DEPTH_LIMIT)
    parse_yaml("a: " + "x" * (YAML_SIZE_LIMIT - 3))


@settings(max_examples=100)
@given(st.binary(max_size=60) | st.text(max_size=60))
def test_any_input__parses_or_raises_invalid_input(data: bytes | str) -> None:
    try:
        parse_yaml(data)
    except InvalidInput as error:
        assert str(error).startswith("<text>")


PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats(allow_nan=False)
    | st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=12),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text("ab1e_:# -", max_size=6), inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=100)
@given(PLAIN)
def test_flow_text__reads_back_equal(value: object) -> None:
    assert parse_yaml(flow_text({"value": value})).content == {"value": value}


def test_settings__are_put_into_a_copy() -> None:
    content = {"reward": {"harm": 1, "jerk": 2}, "gaps_m": [1, 2], "seed": 3}
    found = Override.put(content, Override.parse(["reward.harm=0.5", "gaps_m.1={uniform: [4, 5]}", "new.key=yes"]))
    assert found == {"reward": {"harm": 0.5, "jerk": 2}, "gaps_m": [1, {"uniform": [4, 5]}], "new": {"key": "yes"}}
    assert content == {"reward": {"harm": 1, "jerk": 2}, "gaps_m": [1, 2], "seed": 3}


# ---------------------------------------------------------------- Python files


def test_python_file__is_run_once_as_it_stands_and_refused_once_it_has_changed(tmp_path: Path) -> None:
    file, weights = tmp_path / "mine.py", tmp_path / "mine.pt"
    file.write_text("made = []\ndef half(x: float): return x / 2\nkinds = half.__annotations__")
    weights.write_bytes(b"")
    load_from_file(str(file), "made", str(weights)).append(1)
    assert load_from_file(str(file), "made") == [1]
    assert load_from_file(str(file), "kinds") == {"x": float}  # no text: our own __future__ is not inherited
    assert files_run().keys() >= {"mine.py", "mine.pt"} and files_run()["mine.pt"].startswith("e3b0c44298fc1c14")
    file.write_text("made = [2]")
    with refused("has changed since it was loaded"):
        load_from_file(str(file), "made")
    bad = tmp_path / "bad.py"
    bad.write_text("\nraise SystemExit")
    for _ in range(2):
        with refused(f"file '{bad}', line 2: SystemExit"):
            load_from_file(str(bad), "x")
    os.mkfifo(tmp_path / "pipe.py")
    with refused("is not a plain file"):
        load_from_file(str(tmp_path / "pipe.py"), "x")
