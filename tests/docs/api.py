"""The pages of public names in ``docs/reference/api``: signature, docstring and members of each, by task."""

from __future__ import annotations

import ast
import enum
import inspect
import re
import textwrap
from collections.abc import Iterator
from functools import cached_property
from importlib import import_module
from pathlib import Path
from types import FunctionType
from typing import Any, ForwardRef

from pydantic import BaseModel

import ethbrake_marl
from tests.docs.markdown import first_sentence, link_pages, table, wrap

PACKAGE = Path(ethbrake_marl.__file__).parent
NOT_LISTED = ("metadata", "model_config", "model_post_init")  # members that Gymnasium and pydantic ask for
KEYS = {"Scenario": "scenario-keys", "TrainingRecipe": "recipe-keys"}  # the pages with their fields

# Page -> heading -> names. Names of extensions come from their ``__init__``.
GROUPS: dict[str, dict[str, str]] = {
    "environments": {
        "PettingZoo": "parallel_env EthBrakeParallelEnv env raw_env",
        "Gymnasium": "EthBrakeEnv EthBrakeVectorEnv CostEnv",
        "Stable-Baselines3": "make_sb3_vec_env EthBrakeVecEnv",
        "Observation and reward": "ObservationSpec observation_for choose_observation RewardParams",
        "The engine below all interfaces": "make_engine Engine",
    },
    "scenarios": {
        "Scenarios": "load_scenario list_scenarios Scenario Sample read_worlds worlds_from_table",
        "Worlds and physics": "make_worlds Worlds advance",
    },
    "agents": {
        "Agents": "make_agent agent_names AgentSettings Agent Team",
        "Policies": "load_policy load_shipped Policy policy_agent LearnedAgent",
    },
    "shields": {
        "Shield anything": "shield ShieldOptions ShieldReason ShieldMode",
        "One wrapper per interface": "HybridShield ShieldedEnv ShieldedVectorEnv ShieldedVecEnv shielded_aec",
    },
    "training": {"Training": "train resume TrainResult load_recipe TrainingRecipe Progress"},
    "evaluation": {"Compare agents": "evaluate Evaluation Outcome summarise SummaryTable SummaryRow summarise_by"},
    "results": {"Results files": "read_result compare_results", "Episodes": "record_episode EpisodeRecord"},
    "own-parts": {
        "Register a part": "register_agent register_feature register_objective register_preset register_measure"
        " register_scenarios register_algorithm Part"
    },
    "errors": {"Errors": "EthBrakeError MissingExtra"},
}


def groups() -> dict[str, dict[str, list[str]]]:
    """Page -> heading -> names below ``ethbrake_marl``.

    Raises ``ValueError`` for a public name that is on no page or on two, and for a listed name that is not public.
    """
    pages = {page: {title: names.split() for title, names in parts.items()} for page, parts in GROUPS.items()}
    listed = [name for parts in pages.values() for names in parts.values() for name in names]
    public = [name for name in ethbrake_marl.__all__ if name != "__version__"]
    wrong = {*public}.symmetric_difference(listed) | {name for name in listed if listed.count(name) > 1}
    if wrong:
        raise ValueError(f"each public name belongs on one page of tests/docs/api.py: {', '.join(sorted(wrong))}")
    return {**pages, "extensions": names_of_extensions()}


def names_of_extensions() -> dict[str, list[str]]:
    """Extension -> what its ``__init__`` offers: ``extensions.certified.parse_uncertainty``."""
    found = {}
    for file in sorted(PACKAGE.glob("extensions/*/__init__.py")):
        names = re.findall(r"\b(\w+) as \1\b", file.read_text("utf-8"))
        if names:
            found[file.parent.name] = [f"extensions.{file.parent.name}.{name}" for name in names]
    return found


def page(name: str) -> str:
    """Everything below the beginning of a page: each name with signature, docstring and members."""
    first: dict[int, str] = {}  # identity of an object -> its first name on the page
    texts = []
    for title, names in groups()[name].items():
        texts.append(f"## {title}\n")
        for each in names:
            earlier = first.setdefault(id(resolve(each)), each)
            same = f"### `{each}`\n\nAnother name of [`{earlier}`](#{earlier.lower()}).\n"
            texts.append(describe(each) if earlier == each else same)
    return "\n".join(texts)


def index() -> str:
    """Every name with its first sentence, by page."""
    texts = []
    for page, parts in groups().items():
        rows = []
        for name in (each for names in parts.values() for each in names):
            last = name.rpartition(".")[2]
            rows.append((f"[`{last}`](api/{page}.md#{last.lower()})", first_sentence(own_docstring(name))))
        title = page.replace("-", " ").capitalize()
        texts.append(f"## {title}\n\n{table(('name', 'what it is'), rows)}")
    return "\n".join(texts)


def describe(name: str) -> str:
    """Heading, signature, docstring and members of a public name. Raises ``ValueError`` without a docstring."""
    path, _, last = f"ethbrake_marl.{name}".rpartition(".")
    value = resolve(name)
    imported = f"from {path} import {last}\n\n" if path != "ethbrake_marl" else ""
    parts = [f"### `{last}`", f"```python\n{imported}{signature(last, value)}\n```", docstring(own_docstring(name))]
    if last in KEYS:
        parts.append(f"Its fields: [{KEYS[last].replace('-', ' ')}](../{KEYS[last]}.md).")
    if inspect.isclass(value) and (rows := [*members(value)]):
        parts.append(table(("member", "what it is"), rows).rstrip())
    return "\n\n".join(parts) + "\n"


def resolve(name: str) -> Any:
    """The object that a public name stands for."""
    module, _, last = f"ethbrake_marl.{name}".rpartition(".")
    return getattr(import_module(module), last)


def own_docstring(name: str) -> str:
    """The docstring of the name itself, never an inherited one."""
    value = resolve(name)
    text = vars(value).get("__doc__") if inspect.isclass(value) else value.__doc__
    if not (text or "").strip():
        raise ValueError(f"the public name {name} has no docstring")
    return inspect.cleandoc(text)


def signature(name: str, value: Any) -> str:
    """The signature on one line, or on several of at most 100 characters."""
    if inspect.isclass(value):
        written = (BaseException, BaseModel, enum.Enum)  # whose signature says nothing
        if issubclass(value, written) or getattr(value, "_is_protocol", False):
            return f"class {name}"
        name = f"class {name}"
    found = inspect.signature(value)
    result = "" if inspect.isclass(value) else f" -> {_annotation(found.return_annotation)}"
    words, star = [], False
    for each in found.parameters.values():
        if each.kind is each.KEYWORD_ONLY and not star:
            words.append("*")
        star |= each.kind in (each.KEYWORD_ONLY, each.VAR_POSITIONAL)
        prefix = {each.VAR_POSITIONAL: "*", each.VAR_KEYWORD: "**"}.get(each.kind, "")
        about = "" if each.annotation is each.empty else f": {_annotation(each.annotation)}"
        default = "" if each.default is each.empty else f" = {_default(each.default)}"
        words.append(f"{prefix}{each.name}{about}{default}")
    line = f"{name}({', '.join(words)}){result}"
    if len(line) <= 100:
        return line
    return "\n".join([f"{name}(", *(f"    {word}," for word in words), f"){result}"])


def _annotation(value: Any) -> str:
    if isinstance(value, ForwardRef):
        return value.__forward_arg__
    return value if isinstance(value, str) else getattr(value, "__name__", str(value))


def _default(value: Any) -> str:
    if isinstance(value, enum.Enum):
        return f"{type(value).__name__}.{value.name}"
    text = getattr(value, "__name__", repr(value))
    return "..." if text.startswith("<") else text


def docstring(text: str) -> str:
    """A Google-style docstring as Markdown: paragraphs, arguments as a list, examples as blocks."""
    parts = []
    for part in re.split(r"\n\n+", text.strip()):
        if part.startswith("Args:\n"):
            parts.append(_arguments(part.partition("\n")[2]))
        elif part.startswith(">>> "):
            parts.append(f"```pycon\n{part}\n```")
        else:
            parts.append(wrap(_marked(part)))
    return "\n\n".join(parts)


def _arguments(text: str) -> str:
    items = re.split(r"\n(?=\S)", textwrap.dedent(text))
    lines = []
    for item in items:
        names, _, about = item.partition(": ")
        named = ", ".join(f"`{name.strip()}`" for name in names.split(","))
        lines.append(wrap(f"- {named}: {_marked(about)}", later="  "))
    return "\n".join(lines)


def _marked(text: str) -> str:
    """Code and links of a docstring as Markdown has them."""
    return link_pages(re.sub(r"``(.+?)``", r"`\1`", " ".join(text.split())), "../../")


def members(cls: type) -> Iterator[tuple[str, str]]:
    """Public fields, properties and methods of a class with what each says it is, in the order of the source."""
    if issubclass(cls, enum.Enum):
        for one in cls:
            yield f"`{one.name}` = {one.value}", getattr(one, "text", "")
        return
    arguments = re.findall(r"(?m)^ {4}(\w[\w, ]*): ", cls.__doc__ or "")
    seen = {*NOT_LISTED, *(name for line in arguments for name in line.split(", "))}
    own = [base for base in cls.__mro__ if base.__module__.startswith(ethbrake_marl.__name__)]
    for base in own:
        for name, about in field_comments(base).items():
            if name not in seen:
                seen.add(name)
                yield f"`{name}`", _marked(about)
    for base in own:
        for name, value in vars(base).items():
            if name.startswith("_") or name in seen:
                continue
            seen.add(name)
            value = value.__func__ if isinstance(value, (classmethod, staticmethod)) else value
            if not isinstance(value, (property, cached_property, FunctionType)):
                continue
            text = first_sentence(_marked(inspect.getdoc(getattr(base, name)) or inspect.getdoc(value) or ""))
            if text:
                yield f"`{name}{_parameters(value)}`", text


def _parameters(value: Any) -> str:
    if not inspect.isfunction(value):
        return ""
    names = [
        {each.VAR_POSITIONAL: "*", each.VAR_KEYWORD: "**"}.get(each.kind, "") + each.name
        for each in inspect.signature(value).parameters.values()
    ]
    return f"({', '.join(name for name in names if name not in ('self', 'cls'))})"


def field_comments(cls: type) -> dict[str, str]:
    """Field of a class -> the comment behind it, or else above it, where the shape and the unit stand."""
    try:
        lines = textwrap.dedent(inspect.getsource(cls)).splitlines()
    except (OSError, TypeError):
        return {}
    body = ast.parse("\n".join(lines)).body[0]
    found = {}
    for node in body.body if isinstance(body, ast.ClassDef) else ():
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        if node.target.id.startswith("_"):
            continue
        behind = lines[node.end_lineno - 1][node.end_col_offset :].strip() if node.end_lineno else ""
        above: list[str] = []
        for line in reversed(lines[: node.lineno - 1]):
            if not line.strip().startswith("#"):
                break
            above.insert(0, line.strip())
        comment = [behind] if behind.startswith("#") else above
        if comment and "type:" not in comment[0]:
            found[node.target.id] = " ".join(line.lstrip("# ") for line in comment)
    return found
