"""Mixtures: each world is drawn from one of several scenarios, the *members*, chosen by weight."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.model import FileModel
from ethbrake_marl.files.yaml import Document, flow_text
from ethbrake_marl.worlds.rules import ALTERNATIVES
from ethbrake_marl.worlds.vehicle_types import Weight

if TYPE_CHECKING:
    from ethbrake_marl.worlds.scenario import Scenario

WORDS = ("title", "description", "source")

_OWN = {"name", *WORDS, "mixture", "vehicles"}  # keys of the mixture itself; every other key applies to all members
_ONE_FOR_ALL = ("vehicles", "time_step_s", "horizon_s", "roles", "objective", "observation")  # must not differ
_SHARED = (*_ONE_FOR_ALL, "v2x", "early_impacts")  # the mixture has them if all members agree


class _NameOrContent:
    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return {"anyOf": [{"type": "string"}, {"type": "object"}]}


class Member(FileModel):
    """One scenario of a mixture. In a file ``scenario`` may be a name or path; loading puts the content there."""

    scenario: Annotated[dict[str, Any], _NameOrContent] = Field(
        description="name of a scenario, path of its file, or the content of such a file"
    )
    weight: Weight = Field(
        default=1.0, description="how likely a world is drawn from this scenario, relative to the other scenarios"
    )


def changed_content(content: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return the content of a scenario file with other values; a new way to declare gaps replaces the old way."""
    old = {key for pair in ALTERNATIVES.items() for key in pair if changes.keys() & set(pair)}
    if "speeds_mps" in changes:
        old.add("speed_deviations_mps")
    return {**{key: value for key, value in content.items() if key not in old}, **changes}


def build_members(
    document: Document, keys: Sequence[str], build: Callable[[Document], Scenario]
) -> tuple[Document, tuple[Scenario, ...]]:
    """Build the members of a mixture; return its document, with what all members share, and the members.

    ``keys`` are those of a scenario. Those beside ``mixture`` in the file replace the same keys of every member. A list
    that is not well formed is left to the schema. Raises ``InvalidInput`` for a bad member, and for members that
    cannot be drawn together.
    """
    listed, content = document.content["mixture"], document.content
    if not (isinstance(listed, list | tuple) and listed and all(_is_whole(entry) for entry in listed)):
        return document, ()
    beside = {key: value for key, value in content.items() if key in keys and key not in _OWN}
    members = tuple(build(_member_document(document, i, entry, beside)) for i, entry in enumerate(listed))
    _check_members(document, members)
    mixture = [{**entry, "scenario": member_content(member)} for entry, member in zip(listed, members, strict=True)]
    own = {key: value for key, value in content.items() if key not in beside}
    dumps = [member.model_dump(mode="json", include=set(_SHARED), exclude_none=True) for member in members]
    shared = {key: value for key, value in dumps[0].items() if all(each.get(key) == value for each in dumps)}
    return Document(document.file, {**own, **shared, "mixture": mixture}, document.lines), members


def _is_whole(entry: Any) -> bool:
    known = Member.model_fields.keys()  # the schema reports an unknown key
    return isinstance(entry, dict) and isinstance(entry.get("scenario"), dict) and entry.keys() <= known


def member_content(member: Scenario) -> dict[str, Any]:
    """Return all values that determine the worlds of a member, as plain data without title, description and source."""
    declared = member.model_dump(mode="json", exclude_unset=True, exclude_none=True, exclude=set(WORDS))
    return {**declared, **member.model_dump(mode="json", include=set(_SHARED), exclude_none=True)}


def _member_document(document: Document, i: int, entry: Mapping[str, Any], beside: Mapping[str, Any]) -> Document:
    own = {key: value for key, value in entry["scenario"].items() if key not in WORDS}
    if "vehicles" in document.content:
        own = {"vehicles": document.content["vehicles"], **own}
    inside = {path[3:]: line for path, line in document.lines.items() if path[:3] == ("mixture", i, "scenario")}
    above = {path: line for path, line in document.lines.items() if path and path[0] in beside}
    where = f"{document.file}: mixture[{i}] ({own.get('name', 'without a name')})"
    return Document(where, changed_content(own, beside), {**inside, **above})


def _check_members(document: Document, members: Sequence[Scenario]) -> None:
    where, first = f"{document.where(('mixture',))}: mixture", members[0]
    if (vehicles := document.content.get("vehicles", first.vehicles)) != first.vehicles:
        raise InvalidInput(
            f"{where}: vehicles = {vehicles}: must be {first.vehicles}, the number of vehicles in its scenarios; a"
            " mixture cannot change it"
        )
    for k, member in enumerate(members):
        if member.members:
            raise InvalidInput(
                f"{where}[{k}]: a mixture cannot contain another mixture; list the scenarios of {member.name} instead"
            )
        if member.name in [other.name for other in members[:k]]:
            raise InvalidInput(
                f"{where}[{k}]: {member.name} is listed twice; list it once, with the sum of its weights"
            )
        for key in _ONE_FOR_ALL:
            one, other = (_text(each, key) for each in (first, member))
            if one != other:
                way = "" if key == "vehicles" else f"; to use one {key} for all, write it next to the key mixture"
                raise InvalidInput(
                    f"{where}: {key} must be the same in all scenarios of the mixture, but {first.name} has {one} and"
                    f" {member.name} has {other}{way}"
                )
        _check_extensions(where, first, member)


def _check_extensions(where: str, first: Scenario, member: Scenario) -> None:
    for giver, silent in ((first, member), (member, first)):
        for extension in giver.v2x.extensions:
            if extension not in silent.v2x.extensions:
                keys = " or ".join(f"v2x.{key}" for key in extension.keys)
                raise InvalidInput(
                    f"{where}: scenario {giver.name} has the key {keys}, but scenario {silent.name} does not; write"
                    " one of them in every scenario of the mixture"
                )
            extension.check_alike(where, first, member)


def _text(scenario: Scenario, key: str) -> str:
    value = getattr(scenario, key)
    return "nothing" if value is None else flow_text(dict(value) if key == "roles" else value, 120)
