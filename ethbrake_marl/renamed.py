"""Names of version 1.0 that 2.0 has changed. There are no aliases: the error for an old name says the new one.

The table of the changelog contains these names too.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

RENAMED: Mapping[str, str] = MappingProxyType(  # Python names, scenarios, policies, recipes, shields, commands
    {
        "EthBrake-v1": "EthBrake-v2",
        "drive": "play_to_end",
        "compare": "evaluate",
        "compare_results": "evaluate",
        "fronts": "cooperation",
        "universal-paper": "vine-paper",
        "cooperation-0-sensors": "level-0-sensors",
        "standards-ccrb": "standards-ccrb-2026",
        "standards-ccrm": "standards-ccrm-2026",
    }
)


def new_name(name: object) -> str:
    """Advice such as "renamed to level-0-sensors" for a name of version 1.0; "" for any other."""
    return f"renamed to {RENAMED[name]}" if isinstance(name, str) and name in RENAMED else ""
