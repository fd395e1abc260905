"""The grammar of agents: ``name[:argument][:variant][@policy]``, followed by the wrappers around the agent.

``+search`` comes first, then one shield, for example ``+episode:pairwise`` or ``+step``. Shields have variants too. A
name may be a function in a Python file, ``my_file.py:make_agent``.

The separators ``, + @ :`` may occur in a path. If such a path exists, they do not separate anything there.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches

from ethbrake_marl.agents.registry import SHIELDS, around_entry, around_forms, shield_forms
from ethbrake_marl.errors import InvalidInput, refuse_shipped_path, unknown_name
from ethbrake_marl.scenario.roles import ScriptSpec

_IN_FILE = re.compile(r":(?P<function>[A-Za-z_]\w*)(:(?P<argument>[^\s@]+))?(@(?P<policy>.+))?")

_BEGINS_WITH_FILE = re.compile(r"[^:@]+\.py(:.*)?")


@dataclass(frozen=True, slots=True)
class AgentSpec:
    """Parsed agent specification, for example of ``ppo+search+step``."""

    name: str  # plain name of the agent, or FILE.py:FUNCTION
    argument: str | None  # text after the colon; None without one
    policy: str | None  # text after the @: a path; None without one
    around: tuple[str, ...]  # searches and shields with their arguments, innermost first, as ("search", "step")

    @property
    def core(self) -> str:
        """Specification without the searches and shields around the agent, for example ``ppo@runs/x``."""
        argument = "" if self.argument is None else f":{self.argument}"
        return f"{self.name}{argument}" + ("" if self.policy is None else f"@{self.policy}")

    @property
    def file(self) -> tuple[str, str] | None:
        """Path of the Python file and name of the function in it that makes the agent; None for any other agent."""
        file, _, function = self.name.rpartition(":")
        return (file, function) if file else None

    @property
    def shield(self) -> str | None:
        """The shield as it is written after the ``+``, for example ``episode:pairwise``; None without a shield."""
        return self.around[-1] if self.around and not around_entry(self.around[-1]).inner else None

    def __str__(self) -> str:
        return "".join([self.core, *(f"+{each}" for each in self.around)])


def parse_spec(spec: str) -> AgentSpec:
    """Return a parsed agent specification, such as ``ppo@c+step``. A path in it may contain any character.

    ``ppo@c+step`` is the folder ``c+step`` if it exists, otherwise the folder ``c`` behind the shield; ``ppo@c/+step``
    is always the latter. Raises ``InvalidInput`` for invalid syntax, two shields or another order; ``UnknownName`` for
    an unknown wrapper and for ``X@shipped``, an old spelling.
    """
    core, around = _split_around(spec)
    if file := _python_file(core):
        match = _IN_FILE.fullmatch(core, len(file))
        if match is None:
            raise InvalidInput(
                f"agent {spec!r}: one from a file is FILE.py:FUNCTION, FILE.py:FUNCTION:ARGUMENT or"
                " FILE.py:FUNCTION@POLICY, for instance my_file.py:make_agent"
            )
        return AgentSpec(f"{file}:{match['function']}", match["argument"], match["policy"], around)
    head, at, path = core.partition("@")
    name, argument = ScriptSpec.parse(head if at else core)
    if at and not path:
        raise InvalidInput(f"agent {spec!r}: a path is needed after '@'")
    refuse_shipped_path(path, name)
    return AgentSpec(name, argument, path if at else None, around)


def split_names(text: str, is_one: Callable[[str], bool] = os.path.lexists) -> list[str]:
    """Split a comma-separated list of names, some of which may contain commas.

    Of all texts that begin at the same place, the longest one that ``is_one`` accepts counts as one name; if it accepts
    none, the name ends at the next comma. By default ``is_one`` tests whether a file or folder of that name exists.
    """
    parts, names = text.split(","), list[str]()
    while parts:
        joined = (k for k in range(len(parts), 1, -1) if is_one(",".join(parts[:k])))
        count = next(joined, 1)
        names.append(",".join(parts[:count]))
        parts = parts[count:]
    return names


def split_specs(text: str) -> list[str]:
    """Split a comma-separated list of agent specifications, such as ``coast,ppo``.

    Commas in paths that exist do not split.
    """
    return split_names(text, _is_one_spec)


def _is_one_spec(text: str) -> bool:
    core, around = _strip_around(text)
    head, _, path = core[len(_existing_file(core)) :].partition("@")
    return "," not in "".join([head, *around]) and ("," not in path or os.path.lexists(path))


def _existing_file(core: str) -> str:
    """Return the longest path of an existing Python file with which the specification ``core`` begins, or ""."""
    ends = (match.start() for match in re.finditer(r"(?<=\.py):", core))
    return max((core[:end] for end in ends if os.path.isfile(core[:end])), key=len, default="")


def _python_file(core: str) -> str:
    """Return the path of the Python file, existing or not, with which ``core`` begins, or "" without one."""
    return _existing_file(core) or (core.partition(":")[0] if _BEGINS_WITH_FILE.fullmatch(core) else "")


def _policy_path(core: str) -> str:
    return core[len(_python_file(core)) :].partition("@")[2]


def _strip_around(spec: str) -> tuple[str, list[str]]:
    """Split a specification into the agent and the list of its searches and shields.

    A ``+`` in the path of an existing policy does not split.
    """
    core, around = spec, list[str]()
    while True:
        before, plus, last = core.rpartition("+")
        if not (plus and last.partition(":")[0] in SHIELDS) or os.path.lexists(_policy_path(core)):
            return core, around
        core, around = before, [last, *around]


def _split_around(spec: str) -> tuple[str, tuple[str, ...]]:
    core, around = _strip_around(spec if isinstance(spec, str) else "")
    if not core:
        ScriptSpec.parse(spec)  # raises the error
    before, plus, last = core.rpartition("+")
    if plus and _is_meant_around(before, core, last):
        raise unknown_name("shield or search", last, around_forms())
    for each in around:
        if not around_entry(each).takes(each.partition(":")[2]):
            raise unknown_name("shield or search", each, around_forms())
    shields = [each for each in around if not around_entry(each).inner]
    if len(shields) > 1 or any(each not in shields for each in around[1:]):
        searches = [each for each in around_forms() if around_entry(each).inner]
        raise InvalidInput(
            f"agent {spec!r}: +{', +'.join(searches)} comes first and once, then one shield of"
            f" +{', +'.join(shield_forms())}; for instance ppo+search+step"
        )
    return core, tuple(around)


def _is_meant_around(before: str, core: str, last: str) -> bool:
    """Return whether an unknown word after a ``+`` was probably meant as a search or shield, but misspelt.

    If not, the word is part of an argument or a path.

    Args:
        before: specification up to the ``+``.
        core: specification up to the end of the word.
        last: the unknown word.

    """
    file = _python_file(core)
    if ".py" in last or (file and _IN_FILE.fullmatch(core, len(file))):
        return False  # the + belongs to the path of a Python file, or to its argument
    if ":" not in before and "@" not in before:
        return True
    if "/" in last or "\\" in last:
        return False  # the last part of a path
    return not os.path.lexists(_policy_path(core)) and bool(get_close_matches(last.partition(":")[0], SHIELDS))
