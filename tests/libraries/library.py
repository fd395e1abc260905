"""One library, and the ways in which its user trains on this project: what a file of this folder declares."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent
ROOT = FOLDER.parents[1]
MOST_LINES = 10  # that a user copies


@dataclass(frozen=True)
class Way:
    """One way to train with a library.

    ``function`` is what a user copies, but for a last ``return``. It gives nothing, or what ``eb.policy_agent`` takes
    (or an agent), or that and a function ``n -> harm [n]``: the library's own rollout of a stream's first n worlds.
    With a ``command`` the user copies that instead; the function is called after it.
    """

    title: str
    ran: str  # which algorithm, and how long
    learns: bool  # must beat full braking
    command: str
    function: Callable[[], Any]

    @property
    def code(self) -> str:
        """What a user copies."""
        return textwrap.dedent(self.command).strip() if self.command else shown_lines(self.function)

    @property
    def needed(self) -> str:
        """Functions of the same file that the code calls: networks and settings, which a user has anyway."""
        if self.command:
            return ""
        names = {node.id for node in ast.walk(ast.parse(self.code)) if isinstance(node, ast.Name)}
        found = [value for name, value in self.function.__globals__.items() if name in names and callable(value)]
        return "\n\n\n".join(["from typing import Any", *map(inspect.getsource, found)]) if found else ""


@dataclass
class Library:
    """A library, what its environment holds beside the project, and the ways in.

    ``in_ci``: cheap enough for a stage of the CI.
    """

    title: str
    package: str  # the distribution whose version is told
    requires: tuple[str, ...]  # at the versions that were tried
    about: str  # what is to know, Markdown
    in_ci: bool = False
    version: str = "{}"  # how it is told
    ways: list[Way] = field(default_factory=list)

    def way(
        self, title: str, ran: str, *, learns: bool = False, command: str = ""
    ) -> Callable[[Callable[[], Any]], Callable[[], Any]]:
        """Declare the function below it as a way in."""

        def keep(function: Callable[[], Any]) -> Callable[[], Any]:
            self.ways.append(Way(title, ran, learns, command, function))
            return function

        return keep

    @property
    def install(self) -> str:
        """The packages as a user names them, without the versions that were tried."""
        return " ".join(f"'{r}'" if set("[<> ") & set(r) else r for r in (r.split("==")[0] for r in self.requires))


def shown_lines(function: Callable[..., Any]) -> str:
    """The body of a function without its docstring and a last ``return``."""
    source = textwrap.dedent(inspect.getsource(function))
    (defined,) = ast.parse(source).body
    assert isinstance(defined, ast.FunctionDef)
    body = defined.body[1:] if ast.get_docstring(defined) else defined.body
    body = body[:-1] if isinstance(body[-1], ast.Return) else body
    lines = source.splitlines()[body[0].lineno - 1 : body[-1].end_lineno]
    return textwrap.dedent("\n".join(lines))


# In the order of the page. Each is a file of this folder with one ``LIBRARY``.
NAMES = (
    "stable_baselines3",
    "rl_zoo3",
    "cleanrl",
    "torchrl",
    "benchmarl",
    "rllib",
    "skrl",
    "tianshou",
    "agilerl",
    "minari",
    "supersuit",
)


def load(name: str) -> Library:
    """The library that the file of this name declares; imports nothing of the library itself."""
    found = import_module(f"tests.libraries.{name}").LIBRARY
    assert isinstance(found, Library)
    return found
