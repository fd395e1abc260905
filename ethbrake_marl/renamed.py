"""Names of earlier versions that have changed. There are no aliases: the error for an old name says the new one.

The table of the changelog contains these names too.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

RENAMED: Mapping[str, Mapping[str, str]] = MappingProxyType(  # kind of the name -> old name -> new name
    {
        "attribute": {"drive": "play_to_end", "compare_results": "evaluate", "fronts": "cooperation"},
        "command": {"compare": "evaluate"},
        "scenario": {
            "cooperation-0-sensors": "level-0-sensors",
            "standards-ccrb": "standards-ccrb-2026",
            "standards-ccrm": "standards-ccrm-2026",
        },
        "agent": {"universal-paper": "vine-paper"},
        "recipe": {"universal-paper": "vine-paper"},
        "shipped policy": {"universal-paper": "vine-paper"},
        "reward": {"paper": "paper-reward"},
    }
)


def new_name(kind: str, name: object) -> str:
    """Advice such as "renamed to level-0-sensors" for a name of an earlier version; "" for any other.

    ``kind``: what has the name, such as ``scenario`` (``RENAMED``).
    """
    names = RENAMED.get(kind, {})
    return f"renamed to {names[name]}" if isinstance(name, str) and name in names else ""
