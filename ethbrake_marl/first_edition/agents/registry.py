"""Four registries: agents; shields and searches; variants of agents and shields; and groups of agents.

A *wrapper* is a shield or a search around an agent. In an agent specification, a wrapper stands after a ``+``:
``ppo+step`` is the agent ``ppo`` behind the shield ``step``. A *variant* of an agent or shield is the last word of a
specification, as in ``e_v2x_bm:estimated`` or ``episode:pairwise:estimated``. Each variant has a function of its own,
which makes the agent or shield.

The registered names are entry points (``pyproject.toml``), which are loaded on first use (``ethbrake_marl.registry``).
Therefore this module need not import policies, searches and shields, which import this module.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.first_edition.agents.protocol import Driver, Source
from ethbrake_marl.first_edition.agents.settings import AgentSettings, Factory, Variant, Wrapper
from ethbrake_marl.first_edition.scenario.roles import ScriptSpec
from ethbrake_marl.registry import Registry


@dataclass(frozen=True, slots=True)
class Entry:
    """Registry entry of an agent or of a wrapper."""

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
        """Whether the agent is part of this package. If not, its errors are reported with the name of the agent."""
        is_from_file = ":" in self.name
        return str(getattr(self.make, "__module__", "")).startswith("ethbrake_marl.") and not is_from_file

    @property
    def whole_form(self) -> str:
        """``form`` followed by each registered variant in brackets, for example ``e_v2x_bm[:pairwise][:estimated]``."""
        return self.form + "".join(f"[:{variant}]" for variant in variants_of(self.name))

    @property
    def words(self) -> tuple[str, ...]:
        """All texts that can follow ``+`` to select this wrapper, for example ``("step", "step:estimated")``.

        If ``form`` contains ``[:ARGUMENT]``, any argument is allowed, and the result contains no text for each single
        argument.
        """
        name, *options = re.findall(r"[^\[\]+]+", self.whole_form)
        words = [name]
        for option in options:
            words += [f"{each}{option}" for each in words]
        return tuple(words)

    def takes(self, argument: str) -> bool:
        """Return whether the wrapper accepts ``argument``, the text after the colon; "" means no argument."""
        name = self.words[0]
        return "[:ARGUMENT]" in self.form or (f"{name}:{argument}" if argument else name) in self.words

    def call(self, argument: str | None, settings: AgentSettings, *inside: Driver) -> Driver:
        """Make the agent or wrapper.

        ``argument`` is the text after the first colon, such as ``pairwise``; None: no argument. If the last word of
        this text is a registered variant (``pairwise:estimated``), the variant's function is called. ``inside`` is the
        agent or team to wrap; nothing if the entry is an agent.
        """
        make: Any = self.make
        before, _, last = (argument or "").rpartition(":")
        if last in variants_of(self.name):
            argument, make = before or None, VARIANTS[f"{self.name}.{last}"].make
        driver: Driver = make(*inside, argument, settings)
        return driver


def around_entry(each: str) -> Entry:
    """Return the registry entry of the shield or search in ``each``, a text that stands after a ``+``."""
    return SHIELDS[each.partition(":")[0]]


def agent_names() -> tuple[str, ...]:
    """Return the names that ``make_agent`` knows, in alphabetical order."""
    return tuple(sorted({*AGENTS} - {PROFILE}))


def agent_entries() -> tuple[Entry, ...]:
    """Return the registry entries of all agents, then of all shields and searches.

    Entries that fail to load are left out. The form and description of each entry include its variants.
    """
    agents = [entry for name, entry in AGENTS.usable().items() if name != PROFILE]
    return tuple(_with_variants(entry) for entry in (*agents, *SHIELDS.usable().values()))


def _with_variants(entry: Entry) -> Entry:
    """Return ``entry`` with its variants added to ``form`` and ``about``, without variants that fail to load."""
    usable = VARIANTS.usable()
    for word in variants_of(entry.name):
        if variant := usable.get(f"{entry.name}.{word}"):
            entry = replace(entry, form=f"{entry.form}[:{word}]", about=f"{entry.about}; {word}: {variant.about}")
    return entry


def agents_refused() -> list[str]:
    """Return, for each registered agent, shield or variant that cannot be loaded, one sentence with the reason."""
    reasons = [each.why_not(name) for each in (AGENTS, SHIELDS, VARIANTS) for name in each]
    return [reason for reason in reasons if reason is not None]


def around_forms() -> tuple[str, ...]:
    """Return all texts that can follow the ``+`` of a specification to select a shield or search.

    A shield appears once for each combination of argument and variant (either may be missing), as in ``("search",
    "episode", "episode:pairwise")``.
    """
    return tuple(word for entry in SHIELDS.usable().values() for word in entry.words)


def shield_forms() -> tuple[str, ...]:
    """Return all texts after ``+`` that select a shield without a variant: ``("episode", "episode:pairwise", ...)``.

    A shield with arguments appears once without an argument, and once with each argument.
    """
    return tuple(each for each in around_forms() if not (around_entry(each).inner or is_variant(each)))


def around_one_vehicle() -> list[str]:
    """Return the names of the searches and shields that cannot wrap a team, searches first."""
    return [entry.name for inner in (True, False) for entry in SHIELDS.usable().values()
            if entry.inner is inner and not entry.teams]  # fmt: skip


def shield_settings(name: object) -> Any:
    """Return the settings class of the shield ``name``; None if the shield is unknown or cannot wrap environments."""
    return SHIELDS[name].options if isinstance(name, str) and name in SHIELDS else None


def shield_modes() -> dict[str, Any]:
    """Return a mapping from the name of each shield that can also wrap environments to its settings class."""
    return {name: entry.options for name, entry in SHIELDS.usable().items() if entry.options is not None}


def variants_of(name: str) -> tuple[str, ...]:
    """Return the variants of the agent or shield called ``name``, for example ``("estimated",)``."""
    keys = (key.rpartition(".") for key in VARIANTS)
    return tuple(variant for of, _, variant in keys if of == name)


def is_variant(form: str) -> bool:
    """Return whether ``form`` ends with a registered variant, as ``step:estimated`` does."""
    return form.rpartition(":")[2] in variants_of(form.partition(":")[0])


def settings_needed(shield: str | None) -> Mapping[str, object]:
    """Return the names of the settings that a shield requires, with examples: ``{"uncertainty": "gaps_m=0.5"}``.

    ``shield`` may have an argument, such as ``episode:pairwise``. The result is empty if ``shield`` is None or has a
    variant, such as ``robust:estimated``.
    """
    return {} if shield is None or is_variant(shield) else around_entry(shield).needs


def shields_with(setting: str) -> tuple[str, ...]:
    """Return the names of the installed shields that require ``setting``, such as ``uncertainty``."""
    return tuple(entry.words[0] for entry in SHIELDS.usable().values() if setting in entry.needs)


def group_names() -> tuple[str, ...]:
    """Return the names of all groups of agents, such as ``ladder``. The option ``--agents`` accepts these names."""
    return tuple(dict.fromkeys(name.partition(".")[0] for name in GROUPS))


def agents_of_group(group: str) -> tuple[str, ...]:
    """Return the specifications of all agents in ``group``, a name from ``group_names``.

    Extensions can add agents to a group: agents that are registered under a name ``ladder.WORD`` belong to the group
    ``ladder``. In the result the agents registered under ``ladder`` itself come first; the others follow in
    alphabetical order of ``WORD``.
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

    An installed package registers an agent with an entry point of the group ``ethbrake_marl.first_edition.agents``. The entry point
    refers to the factory, or to a ``Part(factory, about=...)``, which can have further arguments of ``register_agent``.

    Args:
        name: name of the agent, such as ``idm``, without the colon and the argument after it.
        factory: function ``factory(argument, settings)`` that makes the agent. ``argument`` is the text after the colon
            of the specification, or None; ``settings`` is an ``AgentSettings``.
        about: description in one line, which ``ethbrake agent list`` shows.
        knows: sources of knowledge (``Source``) that the agent uses while it drives; ``ethbrake agent list`` shows
            them.
        form: syntax of the agent's specification, which ``ethbrake agent list`` shows; None: ``name[:ARGUMENT]``. If
            ``form`` contains no ``:``, the agent accepts no argument; if it contains no ``@``, no policy.
        takes_policy: whether the specification ``name@policy`` is allowed; the factory finds the policy in
            ``AgentSettings.policy``.

    Registering the same factory again has no effect. Raises ``AlreadyExists`` if the name belongs to another factory,
    and ``InvalidInput`` for an invalid name.

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
    """Register a shield or search, so that ``+name`` may follow every agent in a specification.

    An installed package registers a shield with an entry point of the group ``ethbrake_marl.first_edition.shields``. The entry point
    refers to the wrapper, or to a ``Part(wrapper, about=...)``, which can have further arguments of
    ``register_shield``.

    Args:
        name: name as users write it after ``+``, such as ``step`` in ``ppo+step``, without the colon and the argument.
        wrapper: function ``wrapper(agent, argument, settings)`` that returns an agent around ``agent``. ``argument`` is
            the text after the colon, or None; ``settings`` is an ``AgentSettings``.
        about: description in one line, which ``ethbrake agent list`` shows.
        knows: sources of knowledge that the wrapper uses in addition to the sources of the agent inside.
        form: syntax of the wrapper, ``+name[:WORD]``, with each argument ``WORD`` that is allowed; None: all arguments
            are allowed.
        inner: whether the wrapper is a search. A search stands directly after the agent, before a shield:
            ``ppo+search+step``.
        teams: whether the wrapper can also wrap a team.
        needs: mapping from the name of each required setting of ``AgentSettings`` to an example of its value; None: no
            setting is required.
        options: settings class (``shields.options.ShieldOptions`` or a subclass) of a shield that ``eb.shield(env,
            mode=name)`` can put around environments; None: the wrapper cannot wrap environments.

    Registering the same wrapper again has no effect. Raises ``AlreadyExists`` if the name belongs to another wrapper,
    and ``InvalidInput`` for an invalid name.

    """
    if not isinstance(name, str) or not _PLAIN.fullmatch(name):
        raise InvalidInput(
            f"shield name {name!r}: must begin with a letter a-z and have only the characters a-z, 0-9, _, . and -"
        )
    form = f"+{name}[:ARGUMENT]" if form is None else form
    entry = Entry(name, form, about, knows, wrapper, inner, teams, needs or {}, options)
    SHIELDS.add(name, entry, lambda entry: entry.make is wrapper)


def register_variant(key: str, make: Factory | Wrapper, *, about: str = "a variant of your own") -> None:
    """Register a variant of an agent or shield, for the specifications ``name:variant`` and ``name:argument:variant``.

    An installed package registers a variant with an entry point of the group ``ethbrake_marl.first_edition.variants``.

    Args:
        key: ``name.variant``; for example, ``step.mine`` registers ``step:mine``, a variant of the shield ``step``.
        make: function that is called in place of the factory or wrapper ``name``, with the same arguments. Its
            ``argument`` does not contain the name of the variant.
        about: description in one line, which ``ethbrake agent list`` shows.

    Raises ``AlreadyExists`` if another variant is registered under ``key``.

    """
    VARIANTS.add(key, Variant(make, about), lambda variant: variant.make is make)


_PLAIN = re.compile(r"[a-z][a-z0-9_.-]*")

PROFILE = "profile"  # allowed only as a role in a scenario

AGENTS: Registry[Entry] = Registry("agent", "first_edition.agents", register_agent)

SHIELDS: Registry[Entry] = Registry("shield or search", "first_edition.shields", register_shield)

VARIANTS: Registry[Variant] = Registry("variant of an agent", "first_edition.variants", register_variant)


def _register_group(name: str, specs: tuple[str, ...]) -> None:
    GROUPS.add(name, specs, lambda other: other == specs)


GROUPS: Registry[tuple[str, ...]] = Registry("group of agents", "first_edition.agent_groups", _register_group)
