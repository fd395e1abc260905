"""Plain files that are read and replaced, and YAML; refusals: ``test_refusals``."""

import math
import os
from pathlib import Path

import pytest
from hypothesis import given, settings, strategies as st

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.files.plain import read_plain
from ethbrake_marl.files.python_file import load_from_file
from ethbrake_marl.files.store import check_folder, write_output
from ethbrake_marl.files.yaml import DEPTH_LIMIT, SIZE_LIMIT, flow_text, parse_yaml
from ethbrake_marl.policies.policy import Policy


def test_plain_file__is_read_up_to_the_limit(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"12345678")
    (tmp_path / "link").symlink_to("a")
    assert [read_plain(tmp_path / name, 8) for name in ("a", "link")] == [b"12345678"] * 2


def test_pipe_and_device__are_not_even_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    os.mkfifo(tmp_path / "pipe")
    monkeypatch.setattr("os.open", lambda *args: pytest.fail("opened"))
    for path in (tmp_path / "pipe", Path("/dev/zero"), Path("/dev/tty")):
        with pytest.raises(InvalidInput, match=r"is a device, a pipe or a socket; must be a plain file"):
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
    with pytest.raises(InvalidInput, match=r"is a device, a pipe"):
        read_plain(path, 8)


def test_write__replaces_a_plain_file_by_force_and_takes_the_longest_name(tmp_path: Path) -> None:
    path = tmp_path / ("a" * 255)
    for content, force in ((b"old", False), (b"new", True)):
        write_output(path, content, force=force)
        assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [(path.name, content)]


def test_target__that_cannot_be_replaced_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "mine.onnx"
    monkeypatch.setattr(Policy, "to_onnx", lambda policy: pytest.fail("exported"))
    path.symlink_to("nowhere")
    assert run_command(["agent", "export", "ppo", "--onnx", str(path), "--force"]) == 2
    assert (
        capsys.readouterr().err
        == f"ethbrake: error: {path}: is a symbolic link; give the path of the file to which it points\n"
    )
    assert not path.with_name("nowhere").exists()


def test_folder__takes_files_that_are_new_or_replaced_by_force(tmp_path: Path) -> None:
    (tmp_path / "old.csv").write_text("old")
    check_folder(tmp_path, ("new.csv",))
    check_folder(tmp_path / "new", ("old.csv",))
    check_folder(tmp_path, ("new.csv", "old.csv"), force=True)
    with pytest.raises(AlreadyExists, match=r"old\.csv: already exists"):
        check_folder(tmp_path, ("new.csv", "old.csv"))
    with pytest.raises(InvalidInput, match=r"old\.csv is not a folder; give a new folder"):
        check_folder(tmp_path / "old.csv" / "new")


# ---------------------------------------------------------------- YAML


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1e3", 1000.0),
        ("-2.5E-1", -0.25),
        (".5", 0.5),
        ("3.", 3.0),
        ("12", 12),
        ("+12", 12),
        ("0123", 123),
        ("0o17", 15),
        ("0x1F", 31),
        ("true", True),
        ("false", False),
        ("no", "no"),
        ("yes", "yes"),
        ("on", "on"),
        ("1_000", "1_000"),
        ("12:30", "12:30"),
        ("2024-01-01", "2024-01-01"),
        ("1e", "1e"),
        ("'1e3'", "1e3"),
        ('"true"', "true"),
        ("null", None),
        ("~", None),
        ("", None),
        (".inf", math.inf),
        ("-.inf", -math.inf),
        (".nan", math.nan),
    ],
)
def test_scalar__follows_the_core_schema_of_yaml_1_2(text, value):
    parsed = parse_yaml(f"key: {text}").content["key"]
    assert (repr(parsed), type(parsed)) == (repr(value), type(value))


@pytest.mark.parametrize(("opening", "closing"), ["[]", ("{a: ", "}"), ("- ", "")])
def test_depth_and_size__the_limits_are_allowed(opening: str, closing: str) -> None:
    parse_yaml(opening * DEPTH_LIMIT + "1" + closing * DEPTH_LIMIT)
    parse_yaml("a: " + "x" * (SIZE_LIMIT - 3))


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=60) | st.text(max_size=60))
def test_any_input__parses_or_raises_invalid_input(data):
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


@settings(max_examples=100, deadline=None)
@given(PLAIN)
def test_flow_text__reads_back_equal(value):
    assert parse_yaml(flow_text({"value": value})).content == {"value": value}


# ---------------------------------------------------------------- Python files


def test_python_file__is_run_once_and_refused_once_it_has_changed(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("made = []")
    load_from_file(str(file), "made").append(1)
    assert load_from_file(str(file), "made") == [1]
    file.write_text("made = [2]")
    with pytest.raises(InvalidInput, match="has changed since it was loaded"):
        load_from_file(str(file), "made")


def test_python_file__is_compiled_as_it_stands(tmp_path: Path) -> None:
    file = tmp_path / "noted.py"
    file.write_text("def half(x: float): return x / 2\nkinds = half.__annotations__")
    assert load_from_file(str(file), "kinds") == {"x": float}  # no text: this package's own __future__ is not inherited
