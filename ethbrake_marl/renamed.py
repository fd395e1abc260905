"""Names of version 1.0 that 2.0 has changed. There are no aliases: the error for an old name says the new one.

The changelog shows the same table.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

RENAMED: Mapping[str, str] = MappingProxyType(
    {  # public names of Python, names of scenarios, policies, shields and commands, keys and columns
        "EthBrake-v1": "EthBrake-v2",
        "universal-paper": "vine-paper",
        "experts": "universal or ppo",
        "cooperation-0-sensors": "level-0-sensors",
        "cooperation-1-capacities": "level-1-intent",
        "standards-ccrb": "standards-ccrb-2026",
        "standards-ccrm": "standards-ccrm-2026",
        "robust:estimated": "step:estimated or robust:INTERVALS",
        "compare": "evaluate",
        "compare_results": "evaluate",
        "fronts": "cooperation",
    }
)


def new_name(name: object) -> str:
    """Advice such as "renamed to level-0-sensors" for a name of version 1.0; "" for any other."""
    return f"renamed to {RENAMED[name]}" if isinstance(name, str) and name in RENAMED else ""
