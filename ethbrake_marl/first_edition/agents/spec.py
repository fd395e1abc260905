"""The grammar of agent specifications: ``name[:argument][:variant][@policy]``, followed by wrappers.

The wrappers are at most one search (``+search``), then at most one shield, for example ``+episode:pairwise`` or
``+step``. A shield may also have a variant, as in ``+step:estimated``. ``name`` may be a function in a Python file that
makes the agent: ``my_file.py:make_agent``.

The path of a file or folder may contain the characters ``, + @ :``, which otherwise separate the words of a
specification. An existing path is not split at these characters.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from difflib import get_close_matches

from ethbrake_marl.errors import InvalidInput, refuse_shipped_path, unknown_name
from ethbrake_marl.first_edition.agents.registry import SHIELDS, around_entry, around_forms, shield_forms
from ethbrake_marl.first_edition.scenario.roles import ScriptSpec

_IN_FILE = re.compile(r":(?P<function>[A-Za-z_]\w*)(:(?P<argument>[^\s@]+))?(@(?P<policy>.+))?")

_BEGINS_WITH_FILE = re.compile(r"[^:@]+\.py(:.*)?")


@dataclass(frozen=True, slots=True)
class AgentSpec:
    """Parsed agent specification, such as ``ppo+search+step``."""

    name: str  # plain name of the agent, or FILE.py:FUNCTION
    argument: str | None  # text after the colon; None without a colon
    policy: str | None  # path after the @; None without an @
    around: tuple[str, ...]  # searches and shields with their arguments, innermost first, such as ("search", "step")

    @property
    def core(self) -> str:
        """Specification without the searches and shields around the agent, for example ``ppo@runs/x``."""
        argument = "" if self.argument is None else f":{self.argument}"
        return f"{self.name}{argument}" + ("" if self.policy is None else f"@{self.policy}")

    @property
    def file(self) -> tuple[str, str] | None:
        """For an agent from a Python file: path of the file and name of the function in it; None for other agents."""
        file, _, function = self.name.rpartition(":")
        return (file, function) if file else None

    @property
    def shield(self) -> str | None:
        """The shield as it stands after the ``+``, for example ``episode:pairwise``; None without a shield."""
        return self.around[-1] if self.around and not around_entry(self.around[-1]).inner else None

    def __str__(self) -> str:
        return "".join([self.core, *(f"+{each}" for each in self.around)])


def parse_spec(spec: str) -> AgentSpec:
    """Parse an agent specification, such as ``ppo+step``. Paths in a specification may contain any character.

    ``ppo@c+step`` means the policy in the folder ``c+step`` if this folder exists, otherwise the policy in ``c`` behind
    a shield. ``ppo@c/+step`` always means the policy in ``c`` behind a shield. Raises ``InvalidInput`` for invalid
    syntax, for two shields, and for a shield before a search. Raises ``UnknownName`` for an unknown shield or search,
    and for the old syntax ``X@shipped``.
    """
    core, around = _split_around(spec)
    if file := _python_file(core):
        match = _IN_FILE.fullmatch(core, len(file))
        if match is None:
            raise InvalidInput(
                f"agent {spec!r}: an agent from a file must be FILE.py:FUNCTION, FILE.py:FUNCTION:ARGUMENT or"
                " FILE.py:FUNCTION@POLICY, for instance my_file.py:make_agent"
            )
        return AgentSpec(f"{file}:{match['function']}", match["argument"], match["policy"], around)
    head, at, path = core.partition("@")
    name, argument = ScriptSpec.parse(head if at else core)
    if at and not path:
        raise InvalidInput(f"agent {spec!r}: a path must follow '@'")
    refuse_shipped_path(path, name)
    return AgentSpec(name, argument, path if at else None, around)


def split_names(text: str, is_one: Callable[[str], bool] = os.path.lexists) -> list[str]:
    """Split a comma-separated list of names, some of which may contain commas.

    ``is_one`` returns whether a text with commas is a single name; by default, whether a file or folder with this name
    exists. Each name is the longest beginning of the remaining text for which ``is_one`` returns True; if there is no
    such beginning, the name ends at the next comma.
    """
    parts, names = text.split(","), list[str]()
    while parts:
        joined = (k for k in range(len(parts), 1, -1) if is_one(",".join(parts[:k])))
        count = next(joined, 1)
        names.append(",".join(parts[:count]))
        parts = parts[count:]
    return names


def split_specs(text: str) -> list[str]:
    """Split a list of agent specifications, such as ``coast,ppo``, at each comma outside existing paths."""
    return split_names(text, _is_one_spec)


def _is_one_spec(text: str) -> bool:
    core, around = _strip_around(text)
    head, _, path = core[len(_existing_file(core)) :].partition("@")
    return "," not in "".join([head, *around]) and ("," not in path or os.path.lexists(path))


def _existing_file(core: str) -> str:
    """Return the longest path of an existing Python file with which ``core`` begins, or "" if there is none."""
    ends = (match.start() for match in re.finditer(r"(?<=\.py):", core))
    return max((core[:end] for end in ends if os.path.isfile(core[:end])), key=len, default="")


def _python_file(core: str) -> str:
    """Return the path of the Python file with which ``core`` begins, or "". The file need not exist."""
    return _existing_file(core) or (core.partition(":")[0] if _BEGINS_WITH_FILE.fullmatch(core) else "")


def _policy_path(core: str) -> str:
    return core[len(_python_file(core)) :].partition("@")[2]


def _strip_around(spec: str) -> tuple[str, list[str]]:
    """Split a specification into the agent and the list of its searches and shields.

    If the path of a policy exists, the path is not split at a ``+``.
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
            f"agent {spec!r}: may have at most one search (+{', +'.join(searches)}), then at most one shield"
            f" (+{', +'.join(shield_forms())}), for instance ppo+search+step"
        )
    return core, tuple(around)


def _is_meant_around(before: str, core: str, last: str) -> bool:
    """Return whether the unknown word ``last`` after a ``+`` is probably a misspelt search or shield.

    If not, it is part of an argument or a path. ``before`` is the specification up to the ``+``, without the ``+``, and
    ``core`` the specification up to and including ``last``.
    """
    file = _python_file(core)
    if ".py" in last or (file and _IN_FILE.fullmatch(core, len(file))):
        return False  # the + belongs to the path of a Python file, or to its argument
    if ":" not in before and "@" not in before:
        return True
    if "/" in last or "\\" in last:
        return False  # the last part of a path
    return not os.path.lexists(_policy_path(core)) and bool(get_close_matches(last.partition(":")[0], SHIELDS))
