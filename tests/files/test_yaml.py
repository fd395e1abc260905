from __future__ import annotations

import math

import pytest
from hypothesis import given, settings, strategies as st

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.yaml import DEPTH_LIMIT, SIZE_LIMIT, flow_text, parse_yaml


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
