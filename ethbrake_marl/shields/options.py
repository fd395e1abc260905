"""Settings of a shield: their checks, and the guard that they build.

Every interface takes the same keywords. A shield's mode is a registered name behind an agent's ``+`` (entry-point group
``ethbrake_marl.shields``). Its registry entry names a class of settings: ``ShieldOptions`` itself for ``step`` and
``episode``. A mode with settings of its own has a subclass, which adds and checks these fields and builds its guard.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field, fields
from typing import Any, get_args

from ethbrake_marl.agents.protocol import Agent, Source
from ethbrake_marl.agents.registry import shield_modes, shield_settings
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.engine.scripts import Script
from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.game.harm import HarmCount
from ethbrake_marl.scenario.schema import Scenario, as_scenario
from ethbrake_marl.shields.checks import check_amount
from ethbrake_marl.shields.contract import ShieldGuard
from ethbrake_marl.shields.guard import StepGuard
from ethbrake_marl.shields.paper_hybrid import Bound, EpisodeGuard, HybridAgent
from ethbrake_marl.shields.step import Cap, StepShield


@dataclass(frozen=True)
class ShieldOptions:
    """Keywords of ``eb.shield``, ``HybridShield`` and the other wrappers. A mode of an extension adds its own.

    Args:
        mode: ``step``: each action is certified (some plan after it keeps the harm within the bound) or replaced.
            ``episode``: the paper's Algorithm 1, policy or E-V2X-BM for a whole episode. None: ``step``, unless another
            setting belongs to one mode alone.
        bound: source of ``H*``, the harm of E-V2X-BM, in mode ``episode``: ``coupled``, the engine's physics, or
            ``pairwise``, the paper's closed form.
        harm_count: impacts whose harm is guaranteed: ``first`` (each pair's first) or ``total`` (all).
        allowance: loosens the bound by that much (m2/s2), for fewer replaced actions; not in mode ``episode``.
        cap: ``baseline``: no vehicle ever bears more harm than under the constant actions of least harm. None: only the
            sum over the vehicles is bounded. Mode ``step`` alone.
        intervention_penalty: subtracted from the reward of a step in which the shield replaced the proposed action.
        logging: keep every replaced action in ``shield.log``; not in mode ``episode``.
        shares: add to ``infos`` the harm that each vehicle bears under the current plan and under the constant actions
            of least harm; always added with a ``cap``. Costs a few percent of a step; not in mode ``episode``.
        where: name of the interface, for error messages.

    Raises ``InvalidInput`` naming a setting that does not fit, ``UnknownName`` for an unknown mode.

    >>> import ethbrake_marl as eb
    >>> eb.ShieldOptions(allowance=1.0).mode
    'step'

    """

    mode: str | None = None
    _: KW_ONLY
    bound: Bound = "coupled"
    harm_count: HarmCount = "first"
    allowance: float = 0.0
    cap: Cap | None = None
    intervention_penalty: float = 0.0
    logging: bool = False
    shares: bool = False
    where: str = field(default="shield", compare=False)

    def __new__(cls, mode: str | None = None, **settings: Any) -> ShieldOptions:
        """Create an instance of the class for these settings: the mode's own class, or a subclass of another mode.

        ``ShieldOptions(mode, setting=...)`` thus also accepts settings that only the subclass of an extension's mode
        has.
        """
        if cls is ShieldOptions:
            cls = _class_with("step" if mode is None else check_mode(mode), settings)
        return object.__new__(cls)

    def __post_init__(self) -> None:
        mode, where = check_mode("step" if self.mode is None else self.mode), self.where
        self.check_switches("logging", "shares")
        if mode == "episode":
            for name in (name for name in ("allowance", "logging", "shares") if getattr(self, name)):
                others = sorted((each for each in shield_modes() if each != mode), key=lambda each: each != "step")
                raise misplaced(name, getattr(self, name), mode, others, where)
        elif self.bound != "coupled":
            raise misplaced("bound", self.bound, mode, ["episode"], where)
        caps = get_args(Cap)
        if self.cap is not None and (mode != "step" or self.cap not in caps):
            allowed = "mode step alone takes one" if self.cap in caps else f"must be {', '.join(caps)} or None"
            raise InvalidInput(f"{where}: cap = {self.cap!r}: {allowed}")
        check_amount("intervention_penalty", self.intervention_penalty, where)
        object.__setattr__(self, "mode", mode)

    def check_switches(self, *names: str) -> None:
        """Raise ``InvalidInput`` unless each setting named in ``names`` is True or False."""
        for name in names:
            if not isinstance(getattr(self, name), bool):
                raise InvalidInput(f"{self.where}: {name} = {getattr(self, name)!r}: must be True or False")

    @property
    def written(self) -> str:
        """The mode as it is written behind an agent's ``+``, such as ``step``."""
        return str(self.mode)

    @property
    def adds(self) -> Source:
        """Knowledge that the shield uses in addition to what a policy knows."""
        return Source.MODEL

    def shield(
        self, scenario: Scenario, vehicle: int | tuple[int, ...], others: Mapping[int, Script] | None = None
    ) -> Any:
        """Return a shield with these settings, before any episode. Not for mode ``episode``.

        Args:
            scenario: the scenario of all episodes.
            vehicle: index of the shielded vehicle (0 = front), or indices of several.
            others: index of each other vehicle -> its script; None: the scripts of the scenario.

        """
        return StepShield(
            scenario, vehicle, harm_count=self.harm_count, allowance=self.allowance, others=others, cap=self.cap,
            logging=self.logging,
        )  # fmt: skip

    def check_in(self, scenario: Scenario, *, several: bool) -> None:
        """Raise ``InvalidInput`` if a shield with these settings cannot be used in the scenario.

        With ``several`` (a team is shielded) nothing is checked here; that happens when the guard is made.
        """
        if not several:
            self.shield(scenario, one_learner(scenario) or 0)

    def guard(self, engine: Engine, policies: Mapping[int, Agent], *, several: bool = False, **how: Any) -> ShieldGuard:
        """Return the guard (the part of an engine that certifies or replaces actions) for all learners of an engine.

        Args:
            engine: the engine that the guard will protect.
            policies: vehicle index -> policy that proposes its actions; may be empty except in mode ``episode``.
            several: treat a single learner as a team of one.
            how: further keywords of ``StepGuard``.

        """
        if self.mode == "episode":
            (policy,) = policies.values()
            hybrid = HybridAgent(policy, as_scenario(engine.scenario), bound=self.bound, harm_count=self.harm_count)
            return EpisodeGuard(engine, hybrid, where=self.where)
        shield = self.shield(as_scenario(engine.scenario), shielded_vehicle(engine, several), engine.scripts)
        return StepGuard(engine, policies, shield, where=self.where, shares=self.shares, **how)


def check_mode(mode: object) -> str:
    """Return ``mode`` if it is the name of a shield mode; otherwise raise ``UnknownName``."""
    if shield_settings(mode) is None:
        raise unknown_name("shield mode", mode, shield_modes())
    return str(mode)


def misplaced(name: str, value: object, mode: str, takers: list[str], where: str) -> InvalidInput:
    """Return the error to raise for a setting that a mode does not accept.

    Args:
        name: name of the setting.
        value: its value.
        mode: the mode.
        takers: modes that accept the setting.
        where: name of the interface, with which the message begins.

    """
    do = "does" if len(takers) == 1 else "do"
    return InvalidInput(f"{where}: {name} = {value!r}: mode {mode} takes none; {' and '.join(takers)} {do}")


def shielded_vehicle(engine: Engine, several: bool) -> int | tuple[int, ...]:
    """Return the learners of an engine as ``StepShield`` takes them: one index, or a tuple of indices.

    With ``several``, a single learner is also returned as a tuple.
    """
    vehicles = tuple(engine.learners)
    return vehicles if several or len(vehicles) > 1 else vehicles[0]


def one_learner(scenario: Scenario) -> int | None:
    """Return the index of the scenario's learner; None unless exactly one vehicle learns."""
    return scenario.learners[0] if len(scenario.learners) == 1 else None


def _class_with(mode: str, settings: Mapping[str, Any]) -> type[ShieldOptions]:
    """Return the settings class that has all these settings: the mode's own, or else the first of the other modes'.

    Raises ``UnknownName`` for a setting that no mode has.
    """
    own: type[ShieldOptions] = shield_settings(mode)
    if {*settings} <= _names(own):
        return own
    modes: dict[str, type[ShieldOptions]] = shield_modes()
    for each in modes.values():
        if {*settings} <= _names(each):
            return each
    known = {name for each in modes.values() for name in _names(each)} - {"where"}
    unfit = [name for name in settings if name not in _names(own)]
    wrong = next((name for name in unfit if name not in known), unfit[0])
    raise unknown_name(f"{settings.get('where', 'shield')} option", wrong, known)


def _names(options: Any) -> set[str]:
    return {each.name for each in fields(options)}
