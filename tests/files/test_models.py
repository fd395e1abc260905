"""A model of a file: the first mistake with its place and what would be right, and a schema for editors."""

from typing import Annotated, Literal

import pytest
from pydantic import Field, ValidationError

from ethbrake_marl.files.json_schema import FileSchema
from ethbrake_marl.files.model import FileModel, Wording, first_mistake, read_json_model, read_model
from ethbrake_marl.files.yaml import parse_yaml
from tests.refused import refused


class Inner(FileModel):
    gap_m: float
    kind: Literal["a", "b"] = "a"


class Ambiguous:
    """As a tensor: it cannot tell whether it equals itself."""

    def __ne__(self, other: object) -> bool:
        raise RuntimeError


class Content(FileModel):
    name: str
    inner: Inner | None = None
    sizes: Annotated[tuple[int, ...], Field(strict=False, max_length=3)] = (1,)


MISTAKES = {
    "my.yaml, line 2: nam: unknown key; did you mean name?": "sizes: [x]\nnam: x",
    "my.yaml, line 1: inner.gap: unknown key; did you mean gap_m (metres)?": "inner: {gap: 3}",
    "my.yaml, line 2: colour: unknown key; known: name, inner, sizes": "name: x\ncolour: red",
    "my.yaml: name: missing; write name: x": "sizes: [1]",
    "my.yaml, line 2: inner.gap_m: missing; write name: x": "name: x\ninner: {kind: a}",
    "my.yaml, line 2: inner.kind = c: must be a or b": "name: x\ninner: {gap_m: 1, kind: c}",
    'my.yaml, line 2: inner.gap_m = "1": must be a number, not text; write': "name: x\ninner: {gap_m: '1'}",
    "my.yaml, line 2: sizes = [1, 2, 3, 4]: must have at most 3 entries": "name: x\nsizes: [1, 2, 3, 4]",
    "my.yaml: must be a mapping such as name: x": "[1]",
}  # fmt: skip


@pytest.mark.parametrize("message", MISTAKES)
def test_mistake__is_shown_with_its_place_and_what_would_be_right(message: str) -> None:
    with refused(message):
        read_model(
            parse_yaml(MISTAKES[message], "my.yaml"), Content, Wording(Content, "write name: x"), "such as name: x"
        )


def test_json_of_a_program__is_read_or_its_first_mistake_is_told() -> None:
    assert read_json_model(b'{"name": "x", "sizes": [2]}', Content)[1] == Content(name="x", sizes=(2,))
    with pytest.raises(ValueError, match=r"^inner\.gap_m: is missing$"):
        read_json_model(b'{"name": "x", "inner": {}}', Content)
    with pytest.raises(ValidationError) as caught:
        Inner.model_validate({"gap_m": float("nan"), "kind": 3})
    assert str(first_mistake(caught.value)) == "kind: must be a or b"


def test_mistake__of_an_array_is_told() -> None:
    with pytest.raises(ValidationError) as caught:
        Inner.model_validate({"gap_m": Ambiguous()})
    assert str(first_mistake(caught.value)) == "gap_m: must be a number"


def test_schema__offers_no_null() -> None:
    schema = FileSchema.publish(Content.model_json_schema(schema_generator=FileSchema))
    assert schema["$schema"].startswith("https://json-schema.org/") and "null" not in str(schema)
    assert "None" not in str(schema) and schema["properties"]["sizes"]["default"] == [1]
