"""JSON Schemas of files that people write, for editors that complete and check YAML while one types."""

from __future__ import annotations

from typing import Any

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core.core_schema import NullableSchema, WithDefaultSchema

DIALECT = "https://json-schema.org/draft/2020-12/schema"


class FileSchema(GenerateJsonSchema):
    """In a file a key that is not used is left out; it is never ``null``."""

    def nullable_schema(self, schema: NullableSchema) -> JsonSchemaValue:
        """The schema of the value where there is one."""
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: WithDefaultSchema) -> JsonSchemaValue:
        """As always, but without ``"default": null``."""
        described = super().default_schema(schema)
        return {key: value for key, value in described.items() if key != "default" or value is not None}

    @staticmethod
    def publish(schema: dict[str, Any]) -> dict[str, Any]:
        """The schema as it is printed and shipped: with the dialect that it is written in, first."""
        return {"$schema": DIALECT, **schema}


def schema_lines(kind: str, command: str) -> str:
    """The comment by which a new file names its schema, ``scenario`` or ``recipe``, and the command that prints it."""
    return (
        f"# yaml-language-server: $schema={kind}.schema.json\n"
        "# Your editor completes and checks this file once that schema stands beside it:\n"
        f"#   ethbrake {command} > {kind}.schema.json\n"
    )
