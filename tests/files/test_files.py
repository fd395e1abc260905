"""Plain files that are read and replaced, YAML, one table written in five ways; refusals: ``refusals/files.txt``."""

import io
import json
import math
import os
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings, strategies as st
from rich.console import Console

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.sheet import Column, Estimate, Sheet, csv_text
from ethbrake_marl.files.store import read_plain, write_output
from ethbrake_marl.files.yaml import DEPTH_LIMIT, SIZE_LIMIT, flow_text, parse_yaml
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


def test_document__nests_and_knows_its_lines():
    document = parse_yaml("a:\n  - 1\n  - {b: [2, three]}\nc: |\n  long\n  text\n", "file.yaml")
    assert document.content == {"a": [1, {"b": [2, "three"]}], "c": "long\ntext\n"}
    assert document.line_of(("a", 1, "b", 0)) == 3
    assert document.line_of(("c",)) == 4
    assert document.line_of(("a", 7)) == 1  # not there: the list around it
    assert parse_yaml(b"\xef\xbb\xbfa: 1").content == {"a": 1}  # a byte order mark


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


def test_flow_text__is_what_one_would_write():
    value = {"uniform": [5.0, 7.5], "weights": [True, None], "role": "constant:3.5", "text": "a b"}
    assert flow_text(value) == '{uniform: [5, 7.5], weights: [true, null], role: constant:3.5, text: "a b"}'
    assert flow_text([1.0] * 50, 20) == "[1, 1, 1, 1, 1, 1..."


# ---------------------------------------------------------------- sheets


RATE = Column("Collisions", "rate", digits=1, scale=100.0, unit=" %", short="Hit", interval="below")
CHANGE = Column("Change", sign="+", interval="hidden", wide=True)
HARM = Estimate(0.25, (0.125, 0.5))
SHEET = Sheet(
    "Two agents",
    ["Agent", RATE, CHANGE],
    [("a|b\nknows", HARM, Estimate(-0.001, None)), "paper, <test>", ("Non-E", None, 2.0), ("last",)],
    note="In m²/s².",
)


def drawn(sheet: Sheet, width: int) -> list[str]:
    file = io.StringIO()
    Console(file=file, width=width).print(sheet)
    return [line.rstrip() for line in file.getvalue().splitlines()]


def test_sheet__in_a_terminal() -> None:
    assert drawn(SHEET, 120) == [
        "Two agents", "Agent                  Hit   Change", 35 * "─",
        "a|b                 25.0 %    -0.00", "knows           12.5, 50.0", "",
        "paper, <test>", "Non-E                    –    +2.00", "last", "", "In m²/s².",
    ]  # fmt: skip
    narrow = drawn(SHEET, 60)
    assert narrow[1] == "Agent                  Hit"
    assert not any("2.00" in line for line in narrow)


def test_sheet__moves_no_cursor_and_reads_no_markup() -> None:
    lines = drawn(Sheet("[b]t[/b]", ["[red]x"], [("\x1b[31m[/]",)]), 80)
    assert lines == ["[b]t[/b]", "[red]x", 11 * "─", "\\x1b[31m[/]"]


def test_sheet__in_a_document() -> None:
    assert SHEET.markdown().splitlines() == [
        "| Agent | Collisions | Change |", "| --- | ---: | ---: |",
        "| a\\|b knows | 25.0 % [12.5, 50.0] | -0.00 |", "| paper, <test>: Non-E | – | +2.00 |",
        "| paper, <test>: last |  |  |",
    ]  # fmt: skip


def test_sheet__in_a_notebook() -> None:
    page = SHEET.html()
    assert "<caption>Two agents</caption>" in page
    assert page.endswith("<p>In m²/s².</p>")
    assert '<tr class="block"><th colspan="3" scope="rowgroup">paper, &lt;test&gt;</th></tr>' in page
    assert '<th scope="row">Non-E</th>\n<td>–</td>' in page


def test_sheet__as_data() -> None:
    assert json.loads(json.dumps(SHEET.json()))[0] == {
        "Agent": "a|b\nknows", "rate": 0.25, "rate_interval": [0.125, 0.5], "Change": -0.001, "Change_interval": None
    }  # fmt: skip
    assert SHEET.csv().splitlines() == [
        "Agent,rate,rate_low,rate_high,Change,Change_low,Change_high",
        '"a|b', 'knows",0.25,0.125,0.5,-0.001,,', "Non-E,,,,2.0,,", "last,,,,,,",
    ]  # fmt: skip
    assert csv_text([{"x": 1}], ["x", "y"]) == "x,y\n1,\n"
    with pytest.raises(ValueError, match="z"):
        csv_text([{"z": 1}], ["x"])


def test_sheet__some_columns() -> None:
    some = Sheet("", ["Agent", "Knows", RATE], [("coast", None, 0.5), "section", ("other", None, None)])
    assert some.filled() == [0, 2]
    assert some.only([2, 0]).headings == ["Collisions", "Agent"]
    assert list(some.only([2]).shown()) == [(("50.0 %", ""),), "section", (("–", ""),)]


def test_estimate__in_words() -> None:
    assert Estimate(24.186, (23.85, 24.53)).in_words() == "24.19 [23.85, 24.53]"
    assert Estimate(-0.001, None).in_words() == "0.00"
    assert HARM.in_words(digits=1, scale=100.0, unit=" %") == "25.0 % [12.5, 50.0]"
