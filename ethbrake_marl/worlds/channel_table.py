"""A table of all keys of ``v2x``: the value of each preset, and the meaning, from the fields and presets."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from pydantic.fields import FieldInfo

from ethbrake_marl.files.model import models_in
from ethbrake_marl.files.yaml import flow_text
from ethbrake_marl.worlds.channel import PRESETS, V2X

NO_VALUE = "–"  # the key has no effect with this preset, or no value


def values_of(v2x: V2X) -> dict[str, Any]:
    """All values that have an effect, as plain data: ``V2X.model_validate`` makes the same channel of them."""
    unused = v2x.without_effect()
    values = {key: getattr(v2x, key) for key in (*V2X.model_fields, *(v2x.model_extra or ())) if key not in unused}
    plain = {key: [*value] if isinstance(value, tuple) else value for key, value in values.items()}
    return {key: value for key, value in plain.items() if value is not None}


def key_table(v2x: V2X | None = None) -> list[list[str]]:
    presets = [name for name, settings in PRESETS.items() if "preset" not in settings]  # of this package
    channels = ([] if v2x is None else [v2x]) + [V2X.model_validate(name) for name in presets]
    all_values = [values_of(channel) for channel in channels]
    rows = [["key", *([] if v2x is None else ["here"]), *presets, "meaning"]]
    for key, field in _fields(V2X.key_fields()):
        cells = [_value(values, key.split(".")) for values in all_values]
        rows.append([key, *cells, str(field.description)])
    return rows


def page_table() -> str:
    head, *rows = [[cell.replace("|", r"\|") for cell in row] for row in key_table()]
    rows = [[f"`{key}`", *cells] for key, *cells in rows]
    return "\n".join(f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *rows])


def _fields(fields: Mapping[str, FieldInfo], within: str = "") -> Iterator[tuple[str, FieldInfo]]:
    for key, field in fields.items():
        yield within + key, field
        for model in models_in(field.annotation):
            yield from _fields(model.key_fields(), f"{within}{key}.")


def _value(values: Any, path: list[str]) -> str:
    for key in path:
        values = values.get(key) if isinstance(values, Mapping) else None
    return NO_VALUE if values is None else flow_text(values)
