"""``Member``: one scenario of a mixture, and its weight."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from ethbrake_marl.files.model import FileModel
from ethbrake_marl.scenario.vehicle_types import Weight


class _MemberSchema:
    """Annotation of the field with one scenario of a mixture: its JSON schema allows a mapping or a text.

    In a file the text is the name of a scenario or the path of its file.
    """

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {"anyOf": [{"type": "string"}, {"type": "object"}]}


class Member(FileModel):
    """One scenario of a mixture, with its weight relative to the others.

    In a file, ``scenario`` is a name, a path, or what a scenario file says. Loading replaces a name or a path by what
    that file says, so here it always is a mapping from keys of a scenario to their values.
    """

    scenario: Annotated[dict[str, Any], _MemberSchema] = Field(description="a name, a path, or what its file says")
    weight: Weight = Field(default=1.0, description="how likely it is, relative to the other scenarios")
