"""The vocabulary in which every agent states what it knows of the line while it drives.

An agent says it with an attribute ``knows``: one ``Source``, its name, or several where parts of it know different
things (a shield around a policy). A channel (``v2x``) hides things from the first three sources only.
"""

from __future__ import annotations

from enum import StrEnum

from ethbrake_marl.errors import InvalidInput


class Source(StrEnum):
    """Where knowledge comes from, least first; each has what stands before it as well."""

    SENSORS = "own sensors"  # its own vehicle, and the neighbours that its sensors see
    MESSAGES = "messages"  # the messages that have reached it
    BELIEFS = "believed model"  # also what the scenario says of all lines: ranges, scripts, physics; nothing hidden
    STATE = "true state"  # the others' states, capacities and latencies as they are, received or not
    MODEL = "true model"  # also masses, restitution, every script: enough to roll the line forward in the same physics
    UNSTATED = "not stated"  # of an agent that does not say


Knowledge = tuple[Source, ...]  # in the order of the vocabulary, each once

_SEES_THROUGH = frozenset({Source.STATE, Source.MODEL})


def knowledge_of(agent: object) -> Knowledge:
    """What an agent, or a team, says it knows; ``UNSTATED`` if it says nothing.

    Raises ``InvalidInput`` for a word that is not in the vocabulary.
    """
    stated = getattr(agent, "knows", None)
    words = (Source.UNSTATED,) if stated is None else (stated,) if isinstance(stated, str) else stated
    try:
        found = {Source(word) for word in words}
    except (TypeError, ValueError):
        name = getattr(agent, "name", type(agent).__name__)
        right = ", ".join(repr(source.value) for source in Source)
        raise InvalidInput(f"agent {name!r}: knows = {stated!r:.200}: must be one or several of {right}") from None
    return tuple(source for source in Source if source in found)


def combine(*agents: object, also: Source | None = None) -> Knowledge:
    """What several agents know between them, and what a wrapper around them knows ``also``."""
    known = {source for agent in agents for source in knowledge_of(agent)} | ({also} if also else set())
    return tuple(source for source in Source if source in known)


def sees_through(knowledge: Knowledge) -> bool:
    """Whether it reads of the line what no channel brought."""
    return not _SEES_THROUGH.isdisjoint(knowledge)


def knowledge_text(knowledge: Knowledge) -> str:
    """``messages + true model``; a dash for nothing, which is what a team of nobody knows."""
    return " + ".join(knowledge) or "–"
