"""JSON Schemas of files that people write, for editors that complete and check YAML."""

from __future__ import annotations

from typing import Any

from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core.core_schema import NullableSchema, WithDefaultSchema

DIALECT = "https://json-schema.org/draft/2020-12/schema"


class FileSchema(GenerateJsonSchema):
    """JSON Schema generator for files, in which an unused key is left out and never ``null``."""

    def nullable_schema(self, schema: NullableSchema) -> JsonSchemaValue:
        """Return the JSON schema of an optional value without ``null`` (pydantic's hook)."""
        return self.generate_inner(schema["schema"])

    def default_schema(self, schema: WithDefaultSchema) -> JsonSchemaValue:
        """Return the JSON schema of a value with a default, but without ``"default": null`` (pydantic's hook)."""
        described = super().default_schema(schema)
        return {key: value for key, value in described.items() if key != "default" or value is not None}

    @staticmethod
    def publish(schema: dict[str, Any]) -> dict[str, Any]:
        """Return the schema, ready to be printed or shipped: with the JSON Schema version (``$schema``) first."""
        return {"$schema": DIALECT, **schema}


def schema_lines(kind: str, command: str) -> str:
    """Return a comment for a new YAML file that names its JSON schema, and the command that prints the schema.

    Args:
        kind: ``scenario`` or ``recipe``.
        command: subcommand of ``ethbrake`` that prints the schema, such as ``scenario schema``.

    """
    return (
        f"# yaml-language-server: $schema={kind}.schema.json\n"
        "# Your editor completes and checks this file once that schema stands beside it:\n"
        f"#   ethbrake {command} > {kind}.schema.json\n"
    )
