from __future__ import annotations

import math
import time
from pathlib import Path

import pytest
from hypothesis import given, settings, strategies as st

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.yaml import DEPTH_LIMIT, SIZE_LIMIT, flow_text, parse_yaml, read_yaml


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
    ],
)
def test_scalar__follows_the_core_schema_of_yaml_1_2(text, value):
    parsed = parse_yaml(f"key: {text}").content["key"]
    assert parsed == value
    assert type(parsed) is type(value)


def test_scalar__nan_is_parsed():
    assert math.isnan(parse_yaml("key: .nan").content["key"])


def test_document__nests_and_knows_its_lines():
    document = parse_yaml("a:\n  - 1\n  - {b: [2, three]}\nc: |\n  long\n  text\n", "file.yaml")
    assert document.content == {"a": [1, {"b": [2, "three"]}], "c": "long\ntext\n"}
    assert document.line_of(("a", 1, "b", 0)) == 3
    assert document.line_of(("c",)) == 4
    assert document.line_of(("a", 7)) == 1  # not there: the list around it


@pytest.mark.parametrize(
    ("text", "line", "column", "reason"),
    [
        ("a: 1\nb: &x 2\n", 2, 4, "anchor &x"),
        ("a: &x [1]\nb: *x\n", 1, 4, "anchor &x"),
        ("a: *x\n", 1, 4, "alias *x"),
        ("a: !!int 3\n", 1, 4, "tag tag:yaml.org,2002:int"),
        ("a: ! 3\n", 1, 4, "tag !"),
        ("a: !!python/object/apply:os.system [ls]\n", 1, 4, "tag tag:yaml.org,2002:python"),
        ("<<: {a: 1}\n", 1, 1, "merge key"),
        ("a: 1\nb: 2\na: 3\n", 3, 1, "'a' is given twice, first on line 1"),
        ("o: {a: 1, 'a': 2}\n", 1, 11, "given twice"),
        ("1: a\n", 1, 1, "must be text"),
        ("? [a, b]\n: 1\n", 1, 3, "must be text"),
        ("a: 1\n---\nb: 2\n", 2, 1, "second document"),
        ("%TAG ! tag:x,2000:\n---\na: 1\n", 1, 1, "directives"),
        ("a: [1, 2\nb: 3\n", 2, 2, "not valid YAML"),
        ("a: b: c\n", 1, 5, "not valid YAML"),
        ("a:\n\t- 1\n", 2, 1, "not valid YAML"),
        ("a: \x07\n", 1, 4, "#x0007"),
        ("a: 99999999999999999999\n", 1, 4, "64 bits"),
        (f"a: {'9' * 5000}\n", 1, 4, "64 bits"),
    ],
)
def test_defect__is_named_with_file_line_column_and_reason(text, line, column, reason):
    with pytest.raises(InvalidInput) as caught:
        parse_yaml(text, "bad.yaml")
    message = str(caught.value)
    assert message.startswith(f"bad.yaml, line {line}, column {column}: ")
    assert reason in message


@pytest.mark.parametrize("opening", ["[", "{a: ", "- "])
def test_depth__the_limit_is_allowed_and_one_more_is_not(opening):
    closing = {"[": "]", "{a: ": "}", "- ": ""}[opening]
    parse_yaml(opening * DEPTH_LIMIT + "1" + closing * DEPTH_LIMIT)
    with pytest.raises(InvalidInput, match="nested deeper than 16"):
        parse_yaml(opening * (DEPTH_LIMIT + 1) + "1" + closing * (DEPTH_LIMIT + 1))


def test_size__the_limit_is_allowed_and_one_byte_more_is_not():
    parse_yaml("a: " + "x" * (SIZE_LIMIT - 3))
    with pytest.raises(InvalidInput, match=r"big.yaml: larger than 64 KiB"):
        parse_yaml("a: " + "x" * (SIZE_LIMIT - 2), "big.yaml")


@pytest.fixture(scope="module")
def orderly() -> float:
    """Processor time that a text of nearly the largest size takes."""
    start = time.process_time()
    parse_yaml("a: [" + "x, " * 20_000 + "]")
    return time.process_time() - start


BILLION_LAUGHS = "a: &a [x, x]\n" + "".join(
    f"{new}: &{new} [*{old}, *{old}, *{old}]\n" for old, new in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    "hostile",
    [
        BILLION_LAUGHS,
        "[" * 60_000,
        "{" * 60_000,
        "- " * 30_000,
        "a: " * 20_000,
        "? " * 30_000,
        "a: &a\n  <<: *a\n",
        "!!python/object/new:type {}",
        "a: !!timestamp x",
        "key: " + "'" * 1001,
        "\ud800",
    ],
)
def test_hostile_text__is_refused_quickly(hostile, orderly):
    start = time.process_time()
    with pytest.raises(InvalidInput, match=r"^hostile.yaml"):
        parse_yaml(hostile, "hostile.yaml")
    assert time.process_time() - start < 2.0 * orderly


def test_bytes__not_utf8_are_located():
    with pytest.raises(InvalidInput, match=r"f.yaml, line 2, column 4: not UTF-8 text \(byte 0xff\)"):
        parse_yaml(b"a: 1\nb: \xff\n", "f.yaml")


def test_bytes__a_byte_order_mark_is_ignored():
    assert parse_yaml(b"\xef\xbb\xbfa: 1").content == {"a": 1}


def test_file__missing_or_not_a_file(tmp_path: Path):
    with pytest.raises(InvalidInput, match=r"gone\.yaml: no such file"):
        read_yaml(tmp_path / "gone.yaml")
    with pytest.raises(InvalidInput, match="not a plain file"):
        read_yaml(tmp_path)


def test_file__huge_is_refused_without_reading_it_all(tmp_path: Path):
    huge = tmp_path / "huge.yaml"
    with huge.open("wb") as stream:
        stream.truncate(10**10)  # sparse
    with pytest.raises(InvalidInput, match="larger than 64 KiB"):
        read_yaml(huge)


@settings(max_examples=150, deadline=None)
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


@settings(max_examples=150, deadline=None)
@given(PLAIN)
def test_flow_text__reads_back_equal(value):
    assert parse_yaml(flow_text({"value": value})).content == {"value": value}


def test_flow_text__is_what_one_would_write():
    value = {"uniform": [5.0, 7.5], "weights": [True, None], "role": "constant:3.5", "text": "a b"}
    assert flow_text(value) == '{uniform: [5, 7.5], weights: [true, null], role: constant:3.5, text: "a b"}'
    assert flow_text([1.0] * 50, 20) == "[1, 1, 1, 1, 1, 1..."
