"""Mixtures of scenarios: each world is drawn from one of several scenarios, the *members*, chosen by weight."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.yaml import Document, flow_text
from ethbrake_marl.first_edition.physics.messages import USUAL_PIECES
from ethbrake_marl.first_edition.scenario.declared import ScenarioFields
from ethbrake_marl.first_edition.scenario.fields import QUANTITY
from ethbrake_marl.first_edition.scenario.member import Member

WORDS = ("title", "description", "source")

_OWN = {"name", *WORDS, "mixture"}  # keys of the mixture itself; every other key applies to all members

# keys that must have the same value in all members
_ONE_FOR_ALL = ("vehicles", "time_step_s", "horizon_s", "roles", "objective", "observation")

_SHARED = (*_ONE_FOR_ALL, "v2x", "early_impacts")  # keys that the mixture takes over if all members agree

AnyScenario = TypeVar("AnyScenario", bound=ScenarioFields)


def changed_content(content: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``content`` of a scenario file with the keys of ``changes`` replaced or added.

    A new way to declare gaps or speeds replaces the old way: if ``changes`` has ``time_gaps_s``, ``gaps_m`` is removed.
    """
    old = {key for pair in QUANTITY.alternatives.items() for key in pair if changes.keys() & set(pair)}
    if "speeds_mps" in changes:
        old.add("speed_deviations_mps")
    return {**{key: value for key, value in content.items() if key not in old}, **changes}


def build_members(
    document: Document, build: Callable[[Document], AnyScenario]
) -> tuple[Document, tuple[AnyScenario, ...]]:
    """Build the scenarios listed under the key ``mixture``; return the completed document and these scenarios.

    ``build`` builds one scenario from a document (the parsed content of a file). Keys that stand beside ``mixture`` in
    the file replace the same keys in every listed scenario. If all scenarios have the same value of a setting such as
    ``vehicles`` or ``v2x``, this value is added to the document. If the list under ``mixture`` is invalid, the function
    returns the unchanged document and no scenarios, and the schema rejects the document later. Raises ``InvalidInput``
    if one of the scenarios is invalid, or if the scenarios have different values for a key that they must share; the
    message names the scenario or the key.
    """
    listed, content = document.content["mixture"], document.content
    if not (isinstance(listed, list | tuple) and listed and all(_is_whole(entry) for entry in listed)):
        return document, ()
    fields = set(ScenarioFields.model_fields) - _OWN - {"vehicles"}
    beside = {key: value for key, value in content.items() if key in fields}
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


def member_content(member: ScenarioFields) -> dict[str, Any]:
    """Return all values that determine the worlds of one scenario of a mixture, as plain data.

    The result contains the declared values and the settings that all scenarios of a mixture share, but no title,
    description or source.
    """
    declared = member.model_dump(mode="json", exclude_unset=True, exclude_none=True, exclude=set(WORDS))
    return {**declared, **member.model_dump(mode="json", include=set(_SHARED), exclude_none=True)}


def _member_document(document: Document, i: int, entry: Mapping[str, Any], beside: Mapping[str, Any]) -> Document:
    """Return scenario ``i`` (from 0) of a mixture as a document, without title, description and source.

    ``entry`` is the scenario's entry in the list ``mixture``. The keys in ``beside``, which stand beside ``mixture`` in
    the file, replace the same keys of the scenario.
    """
    own = {key: value for key, value in entry["scenario"].items() if key not in WORDS}
    inside = {path[3:]: line for path, line in document.lines.items() if path[:3] == ("mixture", i, "scenario")}
    own = {**{key: document.content[key] for key in ("vehicles",) if key in document.content}, **own}
    above = {path: line for path, line in document.lines.items() if path and path[0] in beside}
    where = f"{document.file}: mixture[{i}] ({own.get('name', 'without a name')})"
    return Document(where, changed_content(own, beside), {**inside, **above})


def _check_members(document: Document, members: Sequence[ScenarioFields]) -> None:
    """Raise ``InvalidInput`` if the scenarios ``members`` of a mixture cannot be drawn together.

    No scenario of a mixture may itself be a mixture, the names of the scenarios must differ, and all scenarios must
    have the same number of vehicles, time step, horizon, roles, objective and observation.
    """
    where = f"{document.where(('mixture',))}: mixture"
    first = members[0]
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
            one, other = (_value_text(each, key) for each in (first, member))
            if one != other:
                way = "" if key == "vehicles" else f"; to use one {key} for all, write it next to the key mixture"
                raise InvalidInput(
                    f"{where}: {key} must be the same in all scenarios of the mixture, but {first.name} has {one} and"
                    f" {member.name} has {other}{way}"
                )
        samples = [each.v2x.channel.samples(each.time_step_s) for each in (first, member)]
        if samples[0] != samples[1]:
            raise InvalidInput(
                f"{where}: v2x.persistence, and the delay of periodic messages, must be the same in all scenarios of"
                f" the mixture, but {first.name} and {member.name} differ; to use one v2x for all, write it next to the"
                " key mixture"
            )
        says = [each.v2x.channel.tells is not None for each in (first, member)]
        if says[0] != says[1]:
            giver, silent = (first, member) if says[0] else (member, first)
            raise InvalidInput(
                f"{where}: scenario {giver.name} has the key v2x.tells, but scenario {silent.name} does not; write"
                f" v2x.tells in every scenario of the mixture (the default is [{', '.join(USUAL_PIECES)}])"
            )


def _value_text(scenario: ScenarioFields, key: str) -> str:
    value = getattr(scenario, key)
    return "nothing" if value is None else flow_text(dict(value) if key == "roles" else value, 120)
