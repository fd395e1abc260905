"""Settings ``key.path=value`` from the command line; values are YAML."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.yaml import flow_text, parse_yaml


@dataclass(frozen=True, slots=True)
class Override:
    """Such as ``reward.harm=0.5``."""

    text: str  # the setting as written
    path: tuple[str, ...]  # keys that lead to the value, the outermost first; indices (from 0) inside lists
    value: Any  # the value, parsed as YAML

    @property
    def top(self) -> str:
        return self.path[0]

    @property
    def key(self) -> str:
        return ".".join(self.path)

    def inside(self) -> Override:
        """``harm=0.5`` for ``reward.harm=0.5``."""
        return Override(self.text, self.path[1:], self.value)

    @staticmethod
    def parse(texts: Sequence[str]) -> list[Override]:
        """Raises ``InvalidInput`` for no ``=``, an empty key, a repeated path, or a value that is no YAML."""
        overrides: list[Override] = []
        for text in texts:
            key, equals, value = text.partition("=")
            path = tuple(part.strip() for part in key.split("."))
            if not equals or not all(path):
                raise InvalidInput(f"--set {text!r}: must be KEY=VALUE or KEY.KEY=VALUE, for instance gamma=0.99")
            if any(override.path == path for override in overrides):
                raise InvalidInput(f"--set {'.'.join(path)}: this setting is given twice; give it once")
            overrides.append(Override(text, path, parse_yaml(value, f"--set {'.'.join(path)}").content))
        return overrides

    @staticmethod
    def put(content: Mapping[str, Any], overrides: Sequence[Override]) -> dict[str, Any]:
        """With ``content = {"reward": {"harm": 1}, "seed": 3}``, the setting ``reward.harm=2`` gives ``{"reward":
        {"harm": 2}}``. Raises ``InvalidInput`` if a path leads into something other than a mapping or a list.
        """
        changed: dict[str, Any] = {}
        for override in overrides:
            top = override.top
            before = changed[top] if top in changed else copy.deepcopy(content.get(top))
            changed[top] = _place_value(before, override.path[1:], override)
        return changed


def _place_value(part: Any, path: tuple[str, ...], override: Override) -> Any:
    """Missing mappings are created."""
    if not path:
        return override.value
    key, rest = path[0], path[1:]
    if part is None:
        part = {}
    if isinstance(part, Mapping):
        return {**part, key: _place_value(part.get(key), rest, override)}
    if isinstance(part, list | tuple):
        if not (key.isascii() and key.isdigit() and int(key) < len(part)):
            raise InvalidInput(f"--set {override.key}: {key!r} must be an index from 0 to {len(part) - 1}")
        entries = list(part)
        entries[int(key)] = _place_value(entries[int(key)], rest, override)
        return entries
    raise InvalidInput(
        f"--set {override.key}: {key!r} cannot be set inside {flow_text(part, 60)}, which is neither a mapping nor a"
        f" list; leave out the key {key!r}"
    )
