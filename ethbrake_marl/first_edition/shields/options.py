"""Settings of a shield: the keywords of every shield interface, their checks, and the guard that is made from them.

A *mode* is the registered name of a kind of shield (entry-point group ``ethbrake_marl.shields``); its registry entry
contains the class of the mode's settings. The modes ``step`` and ``episode`` use ``ShieldOptions``. A mode with further
settings has a subclass of ``ShieldOptions``, which adds and checks the further fields and makes the guard of the mode.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field, fields
from typing import Any, get_args

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.first_edition.agents.protocol import Agent, Source
from ethbrake_marl.first_edition.agents.registry import shield_modes, shield_settings
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.scenario.schema import Scenario, as_scenario
from ethbrake_marl.first_edition.shields.checks import check_amount
from ethbrake_marl.first_edition.shields.contract import ShieldGuard
from ethbrake_marl.first_edition.shields.guard import StepGuard
from ethbrake_marl.first_edition.shields.paper_hybrid import Bound, EpisodeGuard, HybridAgent
from ethbrake_marl.first_edition.shields.step import Cap, StepShield


@dataclass(frozen=True)
class ShieldOptions:
    """Keywords of ``eb.shield``, ``HybridShield`` and the other wrappers; modes of extensions may accept further ones.

    Args:
        mode: ``step`` certifies or replaces each action. An action is certified if some plan that begins with this
            action keeps the harm within the bound. ``episode`` is the paper's Algorithm 1: the policy or E-V2X-BM
            drives the whole episode. None means ``step``; but if the mode ``step`` does not accept one of the other
            settings, None means the first mode that accepts all of them.
        bound: method to compute ``H*``, the harm of E-V2X-BM, in mode ``episode``: ``coupled`` (the engine's physics)
            or ``pairwise`` (the paper's closed form).
        harm_count: which harm is bounded: ``first`` (first impact of each pair) or ``total`` (every impact).
        allowance: amount by which the bound is loosened, for fewer replaced actions, m2/s2; not allowed in mode
            ``episode``.
        cap: ``baseline``: no vehicle bears more harm than under the constant actions that do the least harm; only
            allowed in mode ``step``. None: only the harm summed over all vehicles is bounded.
        intervention_penalty: amount subtracted from a learner's reward of a step in which the learner's action was
            replaced.
        logging: whether ``shield.log`` collects the replaced actions; not allowed in mode ``episode``.
        shares: whether the infos contain the harm that each vehicle bears under the present plan, and under the
            constant actions that do the least harm; with a ``cap``, they always contain this harm. ``shares=True``
            slows a step by a few percent, and is not allowed in mode ``episode``.
        where: name with which error messages begin: the function or class that the user called.

    Raises ``InvalidInput`` for an invalid setting, and ``UnknownName`` for an unknown mode.

    >>> import ethbrake_marl.first_edition as eb
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
        """Create an instance of the class of ``mode`` or, if it lacks a setting, of the first class with all of them.

        For this reason ``ShieldOptions(mode, setting=...)`` accepts the settings of every installed mode.
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
            allowed = "cap is possible only in mode step" if self.cap in caps else f"must be {', '.join(caps)} or None"
            raise InvalidInput(f"{where}: cap = {self.cap!r}: {allowed}")
        check_amount("intervention_penalty", self.intervention_penalty, where)
        object.__setattr__(self, "mode", mode)

    def check_switches(self, *names: str) -> None:
        """Raise ``InvalidInput`` if a setting whose name is in ``names`` is neither True nor False."""
        for name in names:
            if not isinstance(getattr(self, name), bool):
                raise InvalidInput(f"{self.where}: {name} = {getattr(self, name)!r}: must be True or False")

    @property
    def written(self) -> str:
        """The mode as it is written after the ``+`` of an agent's specification, such as ``step``."""
        return str(self.mode)

    @property
    def adds(self) -> Source:
        """Knowledge that the shield uses beyond what the policy knows."""
        return Source.MODEL

    def shield(
        self, scenario: Scenario, vehicle: int | tuple[int, ...], others: Mapping[int, Script] | None = None
    ) -> Any:
        """Return a new shield with these settings (not for mode ``episode``, whose guard is made without this method).

        Args:
            scenario: the scenario of all episodes.
            vehicle: index of the shielded vehicle (0 = front), or indices of several.
            others: vehicle index -> script of each unshielded vehicle; None: the scenario's scripts.

        """
        return StepShield(
            scenario, vehicle, harm_count=self.harm_count, allowance=self.allowance, others=others, cap=self.cap,
            logging=self.logging,
        )  # fmt: skip

    def check_in(self, scenario: Scenario, *, several: bool) -> None:
        """Raise ``InvalidInput`` if a shield with these settings cannot be used in the scenario.

        If ``several`` is true (a team is shielded), nothing is checked, because ``guard`` makes the same checks.
        """
        if not several:
            self.shield(scenario, one_learner(scenario) or 0)

    def guard(self, engine: Engine, policies: Mapping[int, Agent], *, several: bool = False, **how: Any) -> ShieldGuard:
        """Return the guard for all learners of an engine.

        Args:
            engine: the engine that gets the guard.
            policies: vehicle index -> policy that proposes the vehicle's actions; may be empty except in mode
                ``episode``.
            several: whether to treat a single learner as a team of one vehicle.
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
    """Return the error to raise if the setting ``name`` has a ``value`` that the mode ``mode`` does not accept.

    ``takers`` are the names of the modes that accept it. The message begins with ``where``.
    """
    return InvalidInput(f"{where}: {name} = {value!r}: not a setting of mode {mode}; use mode {' or '.join(takers)}")


def shielded_vehicle(engine: Engine, several: bool) -> int | tuple[int, ...]:
    """Return the index of the engine's only learner; a tuple if several vehicles learn or ``several`` is True."""
    vehicles = tuple(engine.learners)
    return vehicles if several or len(vehicles) > 1 else vehicles[0]


def one_learner(scenario: Scenario) -> int | None:
    """Return the index of the scenario's learner; None unless exactly one vehicle learns."""
    return scenario.learners[0] if len(scenario.learners) == 1 else None


def _class_with(mode: str, settings: Mapping[str, Any]) -> type[ShieldOptions]:
    """Return the settings class of ``mode``; if it lacks one of ``settings``, of the first mode that has all of them.

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
