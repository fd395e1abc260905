"""The grammar of agents: ``name[:argument][@policy]``, and behind it what is put around that agent.

``+refined``, ``+refined:profile`` or, at every decision, ``+refined:50`` or ``+refined:200us`` comes first, then one
shield: ``+episode``, ``+episode:pairwise``, ``+step`` or ``+robust``, each also with ``:believed`` behind it. A name
may be a function of a Python file, ``my_file.py:make_agent``.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from difflib import get_close_matches

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.scenario.roles import parse_agent_spec

REFINED = ("refined", "refined:profile")
SHIELDS = ("episode", "episode:pairwise", "step", "robust", "robust:interior")
BELIEVED = (  # on what was received
    "episode:believed", "episode:pairwise:believed", "step:believed", "robust:believed", "robust:interior:believed",
)  # fmt: skip
AROUND = (*REFINED, *SHIELDS, *BELIEVED)  # in the order in which they are put around an agent

_WITH_BUDGET = re.compile(r"refined:[0-9]+(us)?")
_IN_FILE = re.compile(r"(?P<name>[^:]+\.py:[A-Za-z_]\w*)(:(?P<argument>[^\s@]+))?(@(?P<policy>.+))?")
_BEGINS_WITH_FILE = re.compile(r"[^:@]+\.py(:.*)?")


@dataclass(frozen=True, slots=True)
class AgentSpec:
    """An agent as it is written, in its parts."""

    name: str  # or FILE.py:FUNCTION
    argument: str | None  # after the colon
    policy: str | None  # after the @: a path, or "shipped"
    around: tuple[str, ...]  # of AROUND, innermost first

    @property
    def core(self) -> str:
        """The agent without what is around it."""
        argument = "" if self.argument is None else f":{self.argument}"
        return f"{self.name}{argument}" + ("" if self.policy is None else f"@{self.policy}")

    @property
    def file(self) -> tuple[str, str] | None:
        """The Python file and its function that makes the agent, where the name is one of those."""
        file, _, function = self.name.rpartition(":")
        return (file, function) if file else None

    @property
    def shield(self) -> str | None:
        """The shield around it, if there is one."""
        return self.around[-1] if self.around and self.around[-1] in (*SHIELDS, *BELIEVED) else None

    def __str__(self) -> str:
        return "".join([self.core, *(f"+{each}" for each in self.around)])


def parse_spec(spec: str) -> AgentSpec:
    """The parts of a spec. A path may hold any character; one that ends like ``+step`` is written with a ``/`` behind.

    Raises ``InvalidInput`` for what is not written so, and for two shields or another order; ``UnknownName`` for
    something else behind a ``+``.
    """
    core, around = _split_around(spec)
    if _BEGINS_WITH_FILE.fullmatch(core):
        match = _IN_FILE.fullmatch(core)
        if match is None:
            raise InvalidInput(
                f"agent {spec!r}: one from a file is FILE.py:FUNCTION, FILE.py:FUNCTION:ARGUMENT or"
                " FILE.py:FUNCTION@POLICY, for instance my_file.py:make_agent"
            )
        return AgentSpec(match["name"], match["argument"], match["policy"], around)
    head, at, path = core.partition("@")
    name, argument = parse_agent_spec(head if at else core)
    if at and not path:
        raise InvalidInput(f"agent {spec!r}: a path is needed after '@'")
    return AgentSpec(name, argument, path if at else None, around)


def _split_around(spec: str) -> tuple[str, tuple[str, ...]]:
    core, around = spec if isinstance(spec, str) else "", list[str]()
    if not core:
        parse_agent_spec(spec)  # says what is right
    while True:
        before, plus, last = core.rpartition("+")
        if not plus or not is_around(last):
            break
        core, around = before, [last, *around]
    if plus and _is_meant_around(before, core, last):
        raise unknown_name("shield or refinement", last, AROUND)
    shields = [each for each in around if each in (*SHIELDS, *BELIEVED)]
    if len(shields) > 1 or any(each not in shields for each in around[1:]):
        raise InvalidInput(
            f"agent {spec!r}: +{REFINED[0]} comes first and once, then one shield of +{', +'.join(SHIELDS)}; for"
            " instance ppo@shipped+refined+step"
        )
    return core, tuple(around)


def is_around(word: str) -> bool:
    """Whether this stands behind a ``+``: one of ``AROUND``, or a refinement with a budget for each decision."""
    return word in AROUND or _WITH_BUDGET.fullmatch(word) is not None


def _is_meant_around(before: str, core: str, last: str) -> bool:
    """Whether a word behind a ``+`` that is none of ``AROUND`` is no part of an argument or path either."""
    if ".py" in last or _IN_FILE.fullmatch(core):
        return False  # the + is part of a file's path, or of its argument
    if ":" not in before and "@" not in before:
        return True
    if "/" in last or "\\" in last:
        return False  # the last part of a path
    path = core.partition("@")[2]
    return bool(get_close_matches(last, AROUND)) and not (path and os.path.lexists(path))
