"""Mixtures: each world is drawn from one of several scenarios, the *members*, chosen by weight."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pydantic import Field

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.yaml import Document, YamlPath, flow_text
from ethbrake_marl.worlds.quantity import Part
from ethbrake_marl.worlds.rules import ALTERNATIVES
from ethbrake_marl.worlds.vehicle_types import Weight

if TYPE_CHECKING:
    from ethbrake_marl.worlds.scenario import Scenario

WORDS = ("title", "description", "source")

_OWN = ("name", *WORDS, "mixture")  # keys of the mixture itself; every other key applies to all members
_ONE_FOR_ALL = ("vehicles", "time_step_s", "horizon_s", "roles", "objective", "observation")  # must not differ
_SHARED = (*_ONE_FOR_ALL, "v2x", "early_impacts")  # the mixture has them if all members agree


class Member(Part):
    """One scenario of a mixture. In a file ``scenario`` may be a name or path; loading puts the content there."""

    scenario: dict[str, Any] | str = Field(
        description="name of a scenario, path of its file, or the content of such a file"
    )
    weight: Weight = Field(
        default=1.0, description="how likely a world is drawn from this scenario, relative to the other scenarios"
    )


def changed_content(content: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a scenario file with other values; a new way to declare gaps replaces the old way.

    A key that becomes None is left out.
    """
    old = {key for pair in ALTERNATIVES.items() for key in pair if changes.keys() & set(pair)}
    if "speeds_mps" in changes:
        old.add("speed_deviations_mps")
    kept = {key: value for key, value in content.items() if key not in old}
    return {key: value for key, value in {**kept, **changes}.items() if value is not None}


def build_members(
    document: Document, keys: Sequence[str], build: Callable[[Document], Scenario]
) -> tuple[Document, tuple[Scenario, ...]]:
    """Build the members of a mixture; return its document, with what all members share, and the members.

    ``keys`` are those of a scenario. Those beside ``mixture`` in the file replace the same keys of every member. A list
    that is not well formed is left to the schema. Raises ``InvalidInput`` for a bad member, and for members that
    cannot be drawn together.
    """
    listed, content = document.content["mixture"], document.content
    whole = isinstance(listed, list | tuple) and all(isinstance(e, dict) and "scenario" in e for e in listed)
    if not whole or not listed:
        return document, ()
    beside = {key: value for key, value in content.items() if key in keys and key not in _OWN}
    members: list[Scenario] = []
    for i, entry in enumerate(listed):
        at: YamlPath = ("mixture", i, "scenario")
        member = entry["scenario"]
        if not isinstance(member, dict) or "mixture" in member:
            right = "a mixture cannot contain another mixture; list the scenarios of that mixture instead"
            plain = "must be the content of a scenario as a mapping; a scenario's name works only with load_scenario"
            raise InvalidInput(
                f"{document.where(at)}: mixture[{i}].scenario = {flow_text(member, 60)}:"
                f" {right if isinstance(member, dict) else plain}"
            )
        own = {key: value for key, value in member.items() if key not in WORDS}
        inside = {path[3:]: line for path, line in document.lines.items() if path[:3] == at}
        above = {path: line for path, line in document.lines.items() if path and path[0] in beside}
        where = f"{document.file}: mixture[{i}] ({own.get('name', 'without a name')})"
        members.append(build(Document(where, changed_content(own, beside), {**inside, **above})))
        _check_alike(document.where(("mixture",)), members)
    mixture = [{**entry, "scenario": member_content(member)} for entry, member in zip(listed, members, strict=True)]
    dumps = [member.model_dump(mode="json", include=set(_SHARED), exclude_none=True) for member in members]
    shared = {key: value for key, value in dumps[0].items() if all(each.get(key) == value for each in dumps)}
    own = {key: value for key, value in content.items() if key not in beside}
    return Document(document.file, {**own, **shared, "mixture": mixture}, document.lines), tuple(members)


def member_content(member: Scenario) -> dict[str, Any]:
    """Return all values that determine the worlds of a member, as plain data without title, description and source."""
    shared = member.model_dump(mode="json", include=set(_SHARED), exclude_none=True)
    return {**member.declared(), **shared}


def _check_alike(where: str, members: Sequence[Scenario]) -> None:
    """Refuse the last member if it cannot be drawn together with the others."""
    *others, last = members
    if last.name in [member.name for member in others]:
        raise InvalidInput(f"{where}: mixture: {last.name} is listed twice; list it once, with the sum of its weights")
    for key in _ONE_FOR_ALL:
        one, other = (flow_text(getattr(each, key), 120) for each in (members[0], last))
        if one != other:
            raise InvalidInput(
                f"{where}: mixture: {key} must be the same in all scenarios of the mixture, but {members[0].name} has"
                f" {one} and {last.name} has {other}; to use one {key} for all, write it next to the key mixture"
            )
    first = members[0]
    for giver, silent in ((first, last), (last, first)):
        for extension in giver.v2x.extensions:
            if extension not in silent.v2x.extensions:
                keys = " or ".join(f"v2x.{key}" for key in extension.keys)
                raise InvalidInput(
                    f"{where}: mixture: scenario {giver.name} has the key {keys}, but scenario {silent.name} does not;"
                    " write one of them in every scenario of the mixture"
                )
            extension.check_alike(f"{where}: mixture", first, last)
