"""Registries of agents, of shields and searches, of variants, and of groups of agents.

Names are entry points (``pyproject.toml``), which are loaded on first use (``ethbrake_marl.registry``). This module
therefore need not import policies, searches and shields, which depend on it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from ethbrake_marl.agents.protocol import Driver, Source
from ethbrake_marl.agents.settings import AgentSettings, Factory, Variant, Wrapper
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.registry import Registry
from ethbrake_marl.scenario.roles import ScriptSpec


@dataclass(frozen=True, slots=True)
class Entry:
    """Registry entry of an agent, or of a wrapper: a shield or a search that wraps an agent.

    A wrapper is written after a ``+``: ``ppo+step`` is the agent ``ppo`` behind the shield ``step``.
    """

    name: str  # plain name, without argument
    form: str  # syntax, such as "name[:ARGUMENT][@POLICY]"; no argument without ":", no policy without "@"
    about: str  # description in one line
    knows: Source | Sequence[Source]  # knowledge of the agent while it drives; for a wrapper: knowledge that it adds
    make: Factory | Wrapper  # function that makes the agent or the wrapper
    inner: bool = False  # whether a wrapper is a search, which wraps the agent itself and stands before any shield
    teams: bool = False  # whether a wrapper can also wrap a team
    needs: Mapping[str, object] = field(default_factory=dict)  # name of a required setting -> example of its value
    options: type | None = None  # settings class of a shield that can also wrap an environment

    @property
    def is_ours(self) -> bool:
        """Whether the agent belongs to this package. Errors in other agents are reported with the agent's name."""
        is_from_file = ":" in self.name
        return str(getattr(self.make, "__module__", "")).startswith("ethbrake_marl.") and not is_from_file

    @property
    def whole_form(self) -> str:
        """``form`` followed by each registered variant in brackets, for example ``e_v2x_bm[:pairwise][:estimated]``.

        A variant is a last word that selects another function to make the agent or wrapper.
        """
        return self.form + "".join(f"[:{variant}]" for variant in variants_of(self.name))

    @property
    def words(self) -> tuple[str, ...]:
        """Every text of a wrapper after the ``+`` of a specification, for example ``("step", "step:estimated")``.

        The tuple is complete only if ``form`` lists all arguments of the wrapper.
        """
        name, *options = re.findall(r"[^\[\]+]+", self.whole_form)
        words = [name]
        for option in options:
            words += [f"{each}{option}" for each in words]
        return tuple(words)

    def takes(self, argument: str) -> bool:
        """Return whether a wrapper takes ``argument``, the text after the colon; "" means no argument."""
        name = self.words[0]
        return "[:ARGUMENT]" in self.form or (f"{name}:{argument}" if argument else name) in self.words

    def call(self, argument: str | None, settings: AgentSettings, *inside: Driver) -> Driver:
        """Make the agent or wrapper.

        Args:
            argument: text after the first colon, such as ``pairwise``; None: no argument. If the last word is a
                registered variant (``pairwise:estimated``), the variant's function is called.
            settings: settings for the function that makes the agent or wrapper.
            inside: the agent or team to wrap, if this is the entry of a wrapper; otherwise empty.

        """
        make: Any = self.make
        before, _, last = (argument or "").rpartition(":")
        if last in variants_of(self.name):
            argument, make = before or None, VARIANTS[f"{self.name}.{last}"].make
        driver: Driver = make(*inside, argument, settings)
        return driver


def around_entry(each: str) -> Entry:
    """Return the entry of a shield or search, given the text after the ``+``, such as ``episode:pairwise``."""
    return SHIELDS[each.partition(":")[0]]


def agent_names() -> tuple[str, ...]:
    """Return the names that ``make_agent`` knows, in alphabetical order."""
    return tuple(sorted({*AGENTS} - {PROFILE}))


def agent_entries() -> tuple[Entry, ...]:
    """Return the loadable registry entries of all agents, then of all shields and searches.

    The form and description of an entry include its variants.
    """
    agents = [entry for name, entry in AGENTS.usable().items() if name != PROFILE]
    return tuple(_with_variants(entry) for entry in (*agents, *SHIELDS.usable().values()))


def _with_variants(entry: Entry) -> Entry:
    """Return ``entry`` with its loadable variants in ``form`` and ``about``.

    For example, the form ``e_v2x_bm`` becomes ``e_v2x_bm[:estimated]``, and the description of the variant is added.
    """
    usable = VARIANTS.usable()
    for word in variants_of(entry.name):
        if variant := usable.get(f"{entry.name}.{word}"):
            entry = replace(entry, form=f"{entry.form}[:{word}]", about=f"{entry.about}; {word}: {variant.about}")
    return entry


def agents_refused() -> list[str]:
    """Return one sentence with the reason for each registered agent, shield or variant that cannot be loaded."""
    reasons = [each.why_not(name) for each in (AGENTS, SHIELDS, VARIANTS) for name in each]
    return [reason for reason in reasons if reason is not None]


def around_forms() -> tuple[str, ...]:
    """Return the text of every shield and search after the ``+`` of a specification.

    Each argument and variant has a text of its own, for example ``("search", "episode", "episode:pairwise")``.
    """
    return tuple(word for entry in SHIELDS.usable().values() for word in entry.words)


def shield_forms() -> tuple[str, ...]:
    """Return the text of every shield after the ``+`` of a specification: ``("episode", "robust:interior", ...)``.

    Each argument has a text of its own. Variants and searches are not included.
    """
    return tuple(each for each in around_forms() if not (around_entry(each).inner or is_variant(each)))


def around_one_vehicle() -> list[str]:
    """Return the names of the searches, then of the shields, that cannot wrap a team."""
    return [entry.name for inner in (True, False) for entry in SHIELDS.usable().values()
            if entry.inner is inner and not entry.teams]  # fmt: skip


def shield_settings(name: object) -> Any:
    """Return the settings class of the shield called ``name``; None if it cannot wrap environments or is unknown."""
    return SHIELDS[name].options if isinstance(name, str) and name in SHIELDS else None


def shield_modes() -> dict[str, Any]:
    """Return name -> settings class of every loadable shield that can also wrap environments."""
    return {name: entry.options for name, entry in SHIELDS.usable().items() if entry.options is not None}


def variants_of(name: str) -> tuple[str, ...]:
    """Return the variants of the agent or shield called ``name``, for example ``("estimated",)``.

    A variant is written as the last word, as in ``episode:pairwise:estimated``. If a variant is written, another
    function makes the agent or shield.
    """
    keys = (key.rpartition(".") for key in VARIANTS)
    return tuple(variant for of, _, variant in keys if of == name)


def is_variant(form: str) -> bool:
    """Return whether the last word of ``form`` is a registered variant, as in ``step:estimated``.

    ``form`` is the text of an agent or shield with its argument, without ``+``.
    """
    return form.rpartition(":")[2] in variants_of(form.partition(":")[0])


def settings_needed(shield: str | None) -> Mapping[str, object]:
    """Return the settings that a shield requires: name -> example, such as ``{"uncertainty": "gaps_m=0.5"}``.

    ``shield`` is the text of a shield with its argument, such as ``robust`` or ``episode:pairwise``. The result is
    empty for None and for a variant, such as ``robust:estimated``.
    """
    return {} if shield is None or is_variant(shield) else around_entry(shield).needs


def shields_with(setting: str) -> tuple[str, ...]:
    """Return the names of the installed shields that require ``setting``, such as ``uncertainty``."""
    return tuple(entry.words[0] for entry in SHIELDS.usable().values() if setting in entry.needs)


def group_names() -> tuple[str, ...]:
    """Return the names of groups of agents, such as ``ladder``, which the command option ``--agents`` accepts."""
    return tuple(dict.fromkeys(name.partition(".")[0] for name in GROUPS))


def agents_of_group(group: str) -> tuple[str, ...]:
    """Return the specifications of all agents in ``group``, a name from ``group_names``.

    A group can be extended: agents registered under ``ladder.search``, or another ``ladder.WORD``, follow the agents
    registered under ``ladder``, in alphabetical order of these names.
    """
    return tuple(spec for name in sorted(GROUPS) if name.partition(".")[0] == group for spec in GROUPS[name])


def register_agent(
    name: str,
    factory: Factory,
    *,
    about: str = "an agent of your own",
    knows: Source | Sequence[Source] = Source.UNSTATED,
    form: str | None = None,
    takes_policy: bool = False,
) -> None:
    """Register an agent, so that ``make_agent`` and every command accept ``name`` and ``name:argument``.

    An installed package registers an agent with an entry point of the group ``ethbrake_marl.agents``: its factory, or
    ``Part(factory, about=...)`` with arguments of this function.

    Args:
        name: plain name without argument.
        factory: ``factory(argument, settings)`` makes the agent; ``argument`` is the text after the colon, or None, and
            ``settings`` an ``AgentSettings``.
        about: description in one line, for ``ethbrake agent list``.
        knows: sources of the agent's knowledge while it drives, for ``ethbrake agent list``.
        form: syntax of the agent, for ``ethbrake agent list``; None: ``name[:ARGUMENT]``. If this text has no ``:``,
            the agent takes no argument; if it has no ``@``, the agent takes no policy.
        takes_policy: whether ``name@policy`` is allowed; ``AgentSettings.policy`` is then the policy.

    Registering the same factory again has no effect. Raises ``AlreadyExists`` if the name belongs to another factory,
    and ``InvalidInput`` for a name that is not plain.

    """
    if ScriptSpec.parse(name) != ScriptSpec(name, None) or "@" in name:
        raise InvalidInput(f"agent name {name!r}: must be a name without ':' and '@', for instance my_agent")
    if name in group_names():
        raise AlreadyExists(f"agent {name!r}: is the name of a group of agents; choose another name")
    form = f"{name}[:ARGUMENT]{'[@POLICY]' * takes_policy}" if form is None else form
    AGENTS.add(name, Entry(name, form, about, knows, factory), lambda entry: entry.make is factory)


def register_shield(
    name: str,
    wrapper: Wrapper,
    *,
    about: str = "a shield of your own",
    knows: Source | Sequence[Source] = (),
    form: str | None = None,
    inner: bool = False,
    teams: bool = False,
    needs: Mapping[str, object] | None = None,
    options: type | None = None,
) -> None:
    """Register a shield or another wrapper, so that ``+name`` may follow every agent.

    An installed package registers a shield with an entry point of the group ``ethbrake_marl.shields``: its wrapper, or
    ``Part(wrapper, about=...)`` with arguments of this function.

    Args:
        name: plain name without argument.
        wrapper: ``wrapper(agent, argument, settings)`` returns an agent that wraps ``agent``; ``argument`` is the text
            after the colon, or None, and ``settings`` an ``AgentSettings``.
        about: description in one line, for ``ethbrake agent list``.
        knows: sources of knowledge that the wrapper adds to the agent's.
        form: syntax of the wrapper, ``+name[:WORD]`` with every argument that it takes; None: any argument is allowed.
        inner: whether the wrapper is a search, which wraps the agent itself and is written before any shield.
        teams: whether the wrapper can also wrap a team.
        needs: name of each required setting of ``AgentSettings`` -> example of its value; None: no required settings.
        options: settings class of a shield (``shields.options.ShieldOptions`` or a subclass), which makes it available
            as ``eb.shield(env, mode=name)``; None: the wrapper cannot wrap environments.

    Registering the same wrapper again has no effect. Raises ``AlreadyExists`` if the name belongs to another wrapper,
    and ``InvalidInput`` for a name that is not plain.

    """
    if not isinstance(name, str) or not _PLAIN.fullmatch(name):
        raise InvalidInput(
            f"shield name {name!r}: must begin with a letter a-z and have only the characters a-z, 0-9, _, . and -"
        )
    form = f"+{name}[:ARGUMENT]" if form is None else form
    entry = Entry(name, form, about, knows, wrapper, inner, teams, needs or {}, options)
    SHIELDS.add(name, entry, lambda entry: entry.make is wrapper)


def register_variant(key: str, make: Factory | Wrapper, *, about: str = "a variant of your own") -> None:
    """Register a variant of an agent or a shield: ``name:variant`` and ``name:argument:variant``.

    An installed package registers a variant with an entry point of the group ``ethbrake_marl.variants``.

    Args:
        key: ``name.variant``; for example, ``step.mine`` registers ``step:mine``, a variant of the shield ``step``.
        make: function that replaces the factory or wrapper called ``name``, with the same arguments. The ``argument``
            that this function gets does not contain the name of the variant.
        about: description in one line, for ``ethbrake agent list``.

    Raises ``AlreadyExists`` if the key belongs to another variant.

    """
    VARIANTS.add(key, Variant(make, about), lambda variant: variant.make is make)


_PLAIN = re.compile(r"[a-z][a-z0-9_.-]*")

PROFILE = "profile"  # allowed only as a role in a scenario

AGENTS: Registry[Entry] = Registry("agent", "agents", register_agent)

SHIELDS: Registry[Entry] = Registry("shield or search", "shields", register_shield)

VARIANTS: Registry[Variant] = Registry("variant of an agent", "variants", register_variant)


def _register_group(name: str, specs: tuple[str, ...]) -> None:
    GROUPS.add(name, specs, lambda other: other == specs)


GROUPS: Registry[tuple[str, ...]] = Registry("group of agents", "agent_groups", _register_group)
