"""Mixtures: each world is drawn from one of several scenarios, the *members*, chosen by weight."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import UNSHOWN, refuse, require
from ethbrake_marl.files.yaml import flow_text
from ethbrake_marl.worlds.quantities import ALTERNATIVES

if TYPE_CHECKING:
    from ethbrake_marl.worlds.scenario import Scenario

DESCRIPTIVE_KEYS = ("title", "description", "source")

_MIXTURE_KEYS = (
    "name",
    *DESCRIPTIVE_KEYS,
    "mixture",
)  # keys of the mixture itself; every other key applies to all members
# Members must not differ in these.
_ONE_FOR_ALL = ("vehicles", "time_step_s", "horizon_s", "physics", "roles", "objective", "observation")
_SHARED_KEYS = (*_ONE_FOR_ALL, "v2x", "early_impacts")  # the mixture has them if all members agree


def changed_content(content: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """``content`` of a scenario file with ``changes``; a key that becomes None is left out."""
    old = {key for pair in ALTERNATIVES.items() for key in pair if changes.keys() & set(pair)}
    if "speeds_mps" in changes:
        old.add("speed_deviations_mps")
    unchanged = {key: value for key, value in content.items() if key not in old}
    return {key: value for key, value in {**unchanged, **changes}.items() if value is not None}


def with_members(content: dict[str, Any], scenario: type[Scenario]) -> dict[str, Any]:
    """Content of a mixture with a ``Scenario`` object for each member, and with the values that all members share.

    A key that stands next to ``mixture`` replaces this key in every member. Content with a malformed list is returned
    unchanged, for the schema to refuse.
    """
    entries = content["mixture"]
    if (
        not isinstance(entries, list)
        or not entries
        or not all(isinstance(entry, dict) and "scenario" in entry for entry in entries)
    ):
        return content
    common_content = {
        key: value for key, value in content.items() if key in scenario.model_fields and key not in _MIXTURE_KEYS
    }
    members: list[Scenario] = []
    for i, member in enumerate(entry["scenario"] for entry in entries):
        at = ("mixture", i, "scenario")
        by_name = "must be the content of a scenario as a mapping; a scenario's name works only with load_scenario"
        require(isinstance(member, dict), at, member, by_name)
        nested = "a mixture cannot contain another mixture; list the scenarios of that mixture instead"
        require("mixture" not in member, at, UNSHOWN, nested)
        member_content = {key: value for key, value in member.items() if key not in DESCRIPTIVE_KEYS}
        try:
            members.append(scenario(**changed_content(member_content, common_content)))
        except InvalidInput as error:
            refuse(at, UNSHOWN, str(error))
    _check_alike(members)
    dumps = [member.model_dump(mode="json", include=set(_SHARED_KEYS), exclude_none=True) for member in members]
    shared = {key: value for key, value in dumps[0].items() if all(dump.get(key) == value for dump in dumps)}
    mixture = [{**entry, "scenario": member} for entry, member in zip(entries, members, strict=True)]
    return {key: value for key, value in content.items() if key not in common_content} | shared | {"mixture": mixture}


def _check_alike(members: Sequence[Scenario]) -> None:
    first, *later_members = members
    extended = any(member.v2x.channel_keys for member in members)
    keys = (*_ONE_FOR_ALL, "v2x") if extended else _ONE_FOR_ALL
    for k, later_member in enumerate(later_members, 1):
        twice = later_member.name in [member.name for member in members[:k]]
        right = f"{later_member.name} is listed twice; list it once, with the sum of its weights"
        require(not twice, ("mixture",), UNSHOWN, right)
        for key in keys:
            first_value, later_value = (flow_text(getattr(member, key), 120) for member in (first, later_member))
            right = (
                f"{key} must be the same in all scenarios of the mixture, but {first.name} has {first_value} and"
                f" {later_member.name} has {later_value}; to use one {key} for all, write it next to the key mixture"
            )
            require(first_value == later_value, ("mixture",), UNSHOWN, right)
