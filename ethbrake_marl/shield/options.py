"""The settings of a shield around an environment, checked; and the guard that they make.

Every interface takes the same keywords. A mode is a name of the registry behind an agent's ``+`` (entry-point group
``ethbrake_marl.shields``) whose entry gives a class of settings: ``ShieldOptions`` itself for ``step`` and ``episode``.
A mode with settings of its own gives a subclass, which adds their fields, checks them, and makes its guard.
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
from ethbrake_marl.shield.checks import check_amount
from ethbrake_marl.shield.contract import ShieldGuard
from ethbrake_marl.shield.guard import StepGuard
from ethbrake_marl.shield.paper_hybrid import Bound, EpisodeGuard, HybridAgent
from ethbrake_marl.shield.step import Cap, StepShield


@dataclass(frozen=True)
class ShieldOptions:
    """The keywords of ``eb.shield``, ``HybridShield`` and the other wrappers. A mode of an extension adds its own.

    Args:
        mode: ``step``: each action is certified or replaced. ``episode``: the paper's Algorithm 1, policy or E-V2X-BM
            for a whole episode. None: ``step``, unless another setting belongs to one mode alone.
        bound: the ``H*`` of mode ``episode``, ``coupled`` or the paper's ``pairwise``.
        harm_count: the harm that is guaranteed, ``first`` or ``total``.
        allowance: loosens the bound by that much (m2/s2), for fewer interventions; not in mode ``episode``.
        cap: ``baseline``: no vehicle ever bears more harm than under the constants of least harm, whose sum is the
            bound at the alert. None: only the sum is bounded. Mode ``step`` alone.
        intervention_penalty: taken off the reward of a step in which the shield replaced the proposed action.
        logging: keep every intervention in ``shield.log``; not in mode ``episode``.
        shares: say in ``infos`` what each vehicle bears under the current plan, and under the baseline plan; with a
            ``cap`` the infos always do. Costs a few percent of a step; not in mode ``episode``.
        where: the interface, for messages.

    Raises ``InvalidInput`` naming the setting that does not fit, ``UnknownName`` for a mode.

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
        """Make one of the class that has these settings, as ``pathlib.Path`` makes a path of the system it runs on."""
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
        """Raise ``InvalidInput`` for a setting of these that is neither True nor False."""
        for name in names:
            if not isinstance(getattr(self, name), bool):
                raise InvalidInput(f"{self.where}: {name} = {getattr(self, name)!r}: must be True or False")

    @property
    def written(self) -> str:
        """The mode as it stands behind an agent's ``+``."""
        return str(self.mode)

    @property
    def adds(self) -> Source:
        """What the shield knows of the line beside what a policy knows."""
        return Source.MODEL

    def shield(
        self, scenario: Scenario, vehicle: int | tuple[int, ...], others: Mapping[int, Script] | None = None
    ) -> Any:
        """The shield of one vehicle, or of several, before any episode; not of mode ``episode``.

        ``others``: scripts of the other vehicles, by index; None: the scenario's.
        """
        return StepShield(
            scenario, vehicle, harm_count=self.harm_count, allowance=self.allowance, others=others, cap=self.cap,
            logging=self.logging,
        )  # fmt: skip

    def check_in(self, scenario: Scenario, *, several: bool) -> None:
        """Raise ``InvalidInput`` at once where the shield of a driver refuses the scenario; of a team it is seen later.

        ``several``: the driver is a team.
        """
        if not several:
            self.shield(scenario, one_learner(scenario) or 0)

    def guard(self, engine: Engine, policies: Mapping[int, Agent], *, several: bool = False, **how: Any) -> ShieldGuard:
        """The guard of these settings, for all learners of an engine.

        Args:
            engine: in which it will stand.
            policies: who proposes, by vehicle.
            several: one learner alone is a team, too.
            how: further keywords of ``StepGuard``.

        """
        if self.mode == "episode":
            (policy,) = policies.values()
            hybrid = HybridAgent(policy, as_scenario(engine.scenario), bound=self.bound, harm_count=self.harm_count)
            return EpisodeGuard(engine, hybrid, where=self.where)
        shield = self.shield(as_scenario(engine.scenario), shielded_vehicle(engine, several), engine.scripts)
        return StepGuard(engine, policies, shield, where=self.where, shares=self.shares, **how)


def check_mode(mode: object) -> str:
    """The name of a mode; raises ``UnknownName`` for anything else."""
    if shield_settings(mode) is None:
        raise unknown_name("shield mode", mode, shield_modes())
    return str(mode)


def misplaced(name: str, value: object, mode: str, takers: list[str], where: str) -> InvalidInput:
    """The error for a setting that a mode does not take; ``takers`` are the modes that do."""
    do = "does" if len(takers) == 1 else "do"
    return InvalidInput(f"{where}: {name} = {value!r}: mode {mode} takes none; {' and '.join(takers)} {do}")


def shielded_vehicle(engine: Engine, several: bool) -> int | tuple[int, ...]:
    """The learner of an engine, or all of them, as ``StepShield`` takes them."""
    vehicles = tuple(engine.learners)
    return vehicles if several or len(vehicles) > 1 else vehicles[0]


def one_learner(scenario: Scenario) -> int | None:
    """The index of the vehicle that learns; None where not exactly one does."""
    return scenario.learners[0] if len(scenario.learners) == 1 else None


def _class_with(mode: str, settings: Mapping[str, Any]) -> type[ShieldOptions]:
    """The class of settings of a mode, or else the first of another mode, that has all these settings.

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
