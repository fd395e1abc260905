"""Registries of agents, of the shields and searches around them, of their variants, and of groups of agents.

Names are entry points (``pyproject.toml``), loaded when they are first used (``ethbrake_marl.registry``). So policies,
searches and shields, which belong to layers above this folder, have names without being imported here.
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
    """Entry of the registry: an agent, or a wrapper, which is a shield or a search that goes around an agent.

    A wrapper is written after a ``+``: ``ppo+step`` is the agent ``ppo`` inside the shield ``step``.
    """

    name: str  # plain name, without argument
    form: str  # how it is written, as "name[:ARGUMENT][@POLICY]"; without ":" no argument, without "@" no policy
    about: str  # description in one line
    knows: Source | Sequence[Source]  # knowledge of the agent while it drives; for a wrapper: knowledge that it adds
    make: Factory | Wrapper  # function that makes the agent, or makes the wrapper around an agent
    inner: bool = False  # whether a wrapper goes directly around the agent, inside a shield
    teams: bool = False  # whether a wrapper can go around a team too
    needs: Mapping[str, object] = field(default_factory=dict)  # name of a required ``AgentSettings`` -> an example
    options: type | None = None  # settings class of a shield that can also go around an environment

    @property
    def is_ours(self) -> bool:
        """Whether this package makes the agent; an error in someone else's agent is reported with the agent's name."""
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
        """Every way to write a wrapper after the ``+`` of a specification, for example ``("step", "step:estimated")``.

        Only for a wrapper whose ``form`` lists all arguments that it takes.
        """
        name, *options = re.findall(r"[^\[\]+]+", self.whole_form)
        words = [name]
        for option in options:
            words += [f"{each}{option}" for each in words]
        return tuple(words)

    def takes(self, argument: str) -> bool:
        """Return whether a wrapper takes this argument, the text after the colon; an empty text means no argument."""
        name = self.words[0]
        return "[:ARGUMENT]" in self.form or (f"{name}:{argument}" if argument else name) in self.words

    def call(self, argument: str | None, settings: AgentSettings, *inside: Driver) -> Driver:
        """Make the agent or wrapper.

        Args:
            argument: text after the first colon, such as ``pairwise``; if its last word is a registered variant
                (``pairwise:estimated``), the variant's function is called. None: no argument.
            settings: passed on to the function that makes it.
            inside: for a wrapper, the one agent or team that it goes around.

        """
        make: Any = self.make
        before, _, last = (argument or "").rpartition(":")
        if last in variants_of(self.name):
            argument, make = before or None, VARIANTS[f"{self.name}.{last}"].make
        driver: Driver = make(*inside, argument, settings)
        return driver


def around_entry(each: str) -> Entry:
    """Return the entry of a shield or search; ``each`` is its text in a specification, such as ``episode:pairwise``.

    In ``ppo+episode:pairwise`` this is the text after the ``+``.
    """
    return SHIELDS[each.partition(":")[0]]


def agent_names() -> tuple[str, ...]:
    """Return the names that ``make_agent`` knows, in alphabetical order."""
    return tuple(sorted({*AGENTS} - {PROFILE}))


def agent_entries() -> tuple[Entry, ...]:
    """Return the entries of all agents, then of all shields and searches, that can be loaded.

    The form and description of an entry include its variants.
    """
    agents = [entry for name, entry in AGENTS.usable().items() if name != PROFILE]
    return tuple(_with_variants(entry) for entry in (*agents, *SHIELDS.usable().values()))


def _with_variants(entry: Entry) -> Entry:
    """Return ``entry`` with its variants added to ``form`` and ``about``, as far as they can be loaded.

    A variant is a last word that selects another function: ``e_v2x_bm`` becomes ``e_v2x_bm[:estimated]``, with the
    variant's description.
    """
    usable = VARIANTS.usable()
    for word in variants_of(entry.name):
        if variant := usable.get(f"{entry.name}.{word}"):
            entry = replace(entry, form=f"{entry.form}[:{word}]", about=f"{entry.about}; {word}: {variant.about}")
    return entry


def agents_refused() -> list[str]:
    """Return one sentence for each registered agent, shield or variant of one that cannot be loaded, with the reason.

    The list is empty if everything can be loaded.
    """
    reasons = [each.why_not(name) for each in (AGENTS, SHIELDS, VARIANTS) for name in each]
    return [reason for reason in reasons if reason is not None]


def around_forms() -> tuple[str, ...]:
    """Return every shield and search as it is written in a specification, after the ``+`` of ``ppo+episode``.

    For example ``("search", "episode", "episode:pairwise")``: with each argument and variant that it takes.
    """
    return tuple(word for entry in SHIELDS.usable().values() for word in entry.words)


def shield_forms() -> tuple[str, ...]:
    """Return every shield as it is written after the ``+`` of a specification: ``("episode", "robust:interior", ...)``.

    Arguments are included, variants (last words that select another function) and searches are not.
    """
    return tuple(each for each in around_forms() if not (around_entry(each).inner or is_variant(each)))


def around_one_vehicle() -> list[str]:
    """Return the names of the shields and searches that cannot go around a team, searches first."""
    return [entry.name for inner in (True, False) for entry in SHIELDS.usable().values()
            if entry.inner is inner and not entry.teams]  # fmt: skip


def shield_settings(name: object) -> Any:
    """Return the settings class of the shield called ``name`` if it can also go around environments; otherwise None."""
    return SHIELDS[name].options if isinstance(name, str) and name in SHIELDS else None


def shield_modes() -> dict[str, Any]:
    """Return, for every loadable shield that can also go around environments, its name -> its settings class."""
    return {name: entry.options for name, entry in SHIELDS.usable().items() if entry.options is not None}


def variants_of(name: str) -> tuple[str, ...]:
    """Return the variants of the agent or shield called ``name``, for example ``("estimated",)``.

    A variant is a last word after a further colon, as in ``episode:pairwise:estimated``, that selects another function
    to make the agent or shield.
    """
    keys = (key.rpartition(".") for key in VARIANTS)
    return tuple(variant for of, _, variant in keys if of == name)


def is_variant(form: str) -> bool:
    """Return whether the last word of ``form`` is a registered variant, as in ``step:estimated``.

    ``form``: an agent or shield with its argument, without ``+``.
    """
    return form.rpartition(":")[2] in variants_of(form.partition(":")[0])


def settings_needed(shield: str | None) -> Mapping[str, object]:
    """Return the settings that a shield requires, each with an example: ``{"uncertainty": "gaps_m=0.5"}``.

    ``shield`` is a shield with its argument, such as ``robust`` or ``episode:pairwise``. The result is empty for None
    and for a variant, such as ``robust:estimated``.
    """
    return {} if shield is None or is_variant(shield) else around_entry(shield).needs


def shields_with(setting: str) -> tuple[str, ...]:
    """Return the names of the installed shields that require ``setting``, a name such as ``uncertainty``."""
    return tuple(entry.words[0] for entry in SHIELDS.usable().values() if setting in entry.needs)


def group_names() -> tuple[str, ...]:
    """Return the names that stand for several agents in the command option ``--agents``, such as ``ladder``."""
    return tuple(dict.fromkeys(name.partition(".")[0] for name in GROUPS))


def agents_of_group(group: str) -> tuple[str, ...]:
    """Return the specifications of all agents in ``group``, a name from ``group_names``.

    The group ``ladder`` also contains the agents registered under ``ladder.search``, or any other ``ladder.WORD``: its
    own come first, then these, sorted by name.
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
    """Register an agent, so that ``make_agent`` and every command know ``name`` and ``name:argument``.

    An installed package registers an agent with an entry point of the group ``ethbrake_marl.agents``: its factory, or
    ``Part(factory, about=...)`` with arguments of this function.

    Args:
        name: plain name without argument.
        factory: ``factory(argument, settings)`` makes the agent; ``argument`` is the text after the colon, or None, and
            ``settings`` an ``AgentSettings``.
        about: description in one line, for ``ethbrake agent list``.
        knows: what the agent knows about the line while it drives, for ``ethbrake agent list``.
        form: how the agent is written, for ``ethbrake agent list``. Without ``:`` it takes no argument, without ``@``
            no policy. None: ``name[:ARGUMENT]``.
        takes_policy: whether ``name@policy`` is allowed; the factory finds the policy in ``AgentSettings.policy``.

    Registering the same factory again changes nothing. Raises ``AlreadyExists`` if the name belongs to another factory,
    ``InvalidInput`` for a name that is not plain.

    """
    if ScriptSpec.parse(name) != ScriptSpec(name, None) or "@" in name:
        raise InvalidInput(f"agent name {name!r}: must be a plain name without argument")
    if name in group_names():
        raise AlreadyExists(f"agent {name!r}: stands for several agents in --agents; give another name")
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
        wrapper: ``wrapper(agent, argument, settings)`` makes the agent around ``agent``; ``argument`` is the text after
            the colon, or None, and ``settings`` an ``AgentSettings``.
        about: description in one line, for ``ethbrake agent list``.
        knows: knowledge that the wrapper adds to the agent's.
        form: how it is written, ``+name[:WORD]`` with every word that it takes; None: any argument.
        inner: whether it is no shield and goes directly around the agent, inside a shield.
        teams: whether it can also go around a team.
        needs: name of each required setting of ``AgentSettings`` -> an example; None: none.
        options: settings class of a shield, ``shield.options.ShieldOptions`` or a subclass, with which
            ``eb.shield(env, mode=name)`` knows it too; None: it cannot go around environments.

    Registering the same wrapper again changes nothing. Raises ``AlreadyExists`` if the name belongs to another wrapper,
    ``InvalidInput`` for a name that is not plain.

    """
    if not isinstance(name, str) or not _PLAIN.fullmatch(name):
        raise InvalidInput(f"shield name {name!r}: must be a plain name without argument")
    form = f"+{name}[:ARGUMENT]" if form is None else form
    entry = Entry(name, form, about, knows, wrapper, inner, teams, needs or {}, options)
    SHIELDS.add(name, entry, lambda entry: entry.make is wrapper)


def register_variant(key: str, make: Factory | Wrapper, *, about: str = "a variant of your own") -> None:
    """Register a variant of an agent or a shield: ``name:variant`` and ``name:argument:variant``.

    An installed package registers a variant with an entry point of the group ``ethbrake_marl.variants``.

    Args:
        key: ``name.variant``: ``step.mine`` registers ``step:mine``, a variant of the shield ``step``.
        make: replaces the factory or wrapper of that name, with the same arguments; the argument does not contain the
            variant.
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
