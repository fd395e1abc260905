"""``Member``: one scenario of a mixture, and its weight."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from ethbrake_marl.files.model import FileModel
from ethbrake_marl.first_edition.scenario.vehicle_types import Weight


class _MemberSchema:
    """Pydantic annotation of ``Member.scenario``: the field's JSON schema allows a mapping or a text.

    In a file, a text in the field ``scenario`` is the name of a scenario or the path of its file.
    """

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {"anyOf": [{"type": "string"}, {"type": "object"}]}


class Member(FileModel):
    """One scenario of a mixture, with its weight relative to the others.

    In a file, ``scenario`` is a scenario's name, the path of its file, or the content of such a file. Loading replaces
    a name or path by the content of the scenario's file, so ``scenario`` is a mapping in a loaded ``Member``.
    """

    scenario: Annotated[dict[str, Any], _MemberSchema] = Field(
        description="name of a scenario, path of its file, or the content of such a file"
    )
    weight: Weight = Field(
        default=1.0, description="how likely a world is drawn from this scenario, relative to the other scenarios"
    )
