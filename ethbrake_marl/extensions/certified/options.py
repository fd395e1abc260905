"""Settings of ``robust`` and ``estimated`` shields."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.certified.estimated_shield import EstimatedShield
from ethbrake_marl.extensions.certified.guards import EstimatedGuard, RobustGuard, RobustMode
from ethbrake_marl.extensions.certified.robust_step import RobustShield
from ethbrake_marl.extensions.certified.uncertainty import UNCERTAINTY_EXAMPLE, Uncertainty, parse_uncertainty
from ethbrake_marl.first_edition.agents.protocol import Agent, Source
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.scenario.schema import Scenario, as_scenario
from ethbrake_marl.first_edition.shields.contract import ShieldGuard, ShieldMode
from ethbrake_marl.first_edition.shields.options import (
    ShieldOptions,
    check_mode,
    misplaced,
    one_learner,
    shielded_vehicle,
)


@dataclass(frozen=True)
class RobustOptions(ShieldOptions):
    """``eb.ShieldOptions`` with further settings for incomplete knowledge.

    Mode ``robust`` certifies actions in the reported world and in the corners, where every uncertain quantity is at one
    end of its interval. The bound does not cover the worlds between the corners (see ``RobustShield``).

    Args:
        mode: a mode of ``eb.ShieldOptions``, or ``robust``, which extends mode ``step`` to uncertain worlds. None means
            ``robust`` if ``uncertainty`` is given, otherwise ``step``.
        uncertainty: for mode ``robust``, an interval around each uncertain quantity, such as ``"gaps_m=0.5"``.
        estimated: if True, certify actions in the estimated world, which uses only the information that the vehicle
            received and the scenario's ranges. Allowed only in modes ``step`` and ``robust``, with one learner, and
            without ``uncertainty``, ``allowance``, ``cap``, ``logging`` and ``shares``.

    Raises ``InvalidInput`` and ``UnknownName`` as ``eb.ShieldOptions`` does.

    >>> import ethbrake_marl.first_edition as eb
    >>> eb.ShieldOptions(uncertainty="gaps_m=0.5").mode
    'robust'

    """

    uncertainty: Uncertainty | str | None = None
    estimated: bool = False

    def __post_init__(self) -> None:
        if self.mode is None:
            object.__setattr__(self, "mode", "step" if self.uncertainty is None else "robust")
        mode, where = check_mode(self.mode), self.where
        self.check_switches("estimated")
        if self.estimated:
            if mode == "episode":
                raise misplaced("estimated", True, mode, ["step", "robust"], where)
            without = {"uncertainty": None, "allowance": 0.0, "cap": None, "logging": False, "shares": False}
            for name, value in without.items():
                if getattr(self, name) != value:
                    raise InvalidInput(
                        f"{where}: {name} = {getattr(self, name)!r}: must be {value!r} if estimated = True"
                    )
        uncertainty = None if self.estimated else mode_uncertainty(mode, self.uncertainty, where)
        object.__setattr__(self, "uncertainty", uncertainty)
        super().__post_init__()

    @property
    def written(self) -> str:
        """Text after the ``+`` in the spec of an agent that has a shield with these settings, such as
        ``robust:estimated`` for ``ppo+robust:estimated``.
        """
        return f"{self.mode}{':estimated' if self.estimated else ''}"

    @property
    def adds(self) -> Source:
        """Source of the information that the shield uses in addition to the policy's information."""
        return Source.ESTIMATES if self.estimated else super().adds

    def shield(
        self, scenario: Scenario, vehicle: int | tuple[int, ...], others: Mapping[int, Script] | None = None
    ) -> Any:
        """Return a new shield for ``vehicle``, in which no episode has begun.

        ``vehicle`` is the index of the shielded vehicle, or several indices for modes that shield several vehicles.
        ``others`` contains the scripts of the other vehicles by vehicle index; None: the scripts of the scenario.
        """
        if self.estimated:
            assert isinstance(vehicle, int)
            robust = self.mode == "robust"
            return EstimatedShield(scenario, vehicle, harm_count=self.harm_count, robust=robust, others=others)
        if self.mode == "robust":
            return RobustShield(
                scenario, vehicle, harm_count=self.harm_count, allowance=self.allowance, others=others, cap=self.cap,
                uncertainty=checked_uncertainty(self.uncertainty), logging=self.logging,
            )  # fmt: skip
        return super().shield(scenario, vehicle, others)

    def check_in(self, scenario: Scenario, *, several: bool) -> None:
        """Raise ``InvalidInput`` if a shield with these settings refuses the scenario.

        ``several`` is True if one shield decides for all learners together.
        """
        one = one_learner(scenario)
        if self.estimated:  # the scenario's scripts are used only if the scenario has exactly one learner
            self.shield(scenario, one or 0, {} if one is None else None)
        else:
            super().check_in(scenario, several=several)

    def guard(self, engine: Engine, policies: Mapping[int, Agent], *, several: bool = False, **how: Any) -> ShieldGuard:
        """Return the guard that connects a shield with these settings to ``engine``, whose learners are shielded.

        ``policies`` maps the index of each vehicle to the agent that proposes its actions. ``several`` is True if one
        shield decides for all learners together. ``how`` are further keyword arguments of ``StepGuard``.
        """
        scenario, scripts, where = as_scenario(engine.scenario), engine.scripts, self.where
        if self.estimated:
            if len(engine.learners) > 1:
                raise InvalidInput(
                    f"{where}: estimated = True: the shield can control only one learner; make the environment with one"
                    " learner, for instance learners=['vehicle_2']"
                )
            mode = RobustMode.ROBUST if self.mode == "robust" else ShieldMode.STEP
            shield = self.shield(scenario, engine.learners[0], scripts)
            return EstimatedGuard(engine, policies, shield, mode=mode, where=where)
        if self.mode == "robust":
            shield = self.shield(scenario, shielded_vehicle(engine, several), scripts)
            mode = RobustMode.ROBUST
            return RobustGuard(engine, policies, shield, mode=mode, where=where, shares=self.shares, **how)
        return super().guard(engine, policies, several=several, **how)


def checked_uncertainty(given: object) -> Uncertainty | None:
    """Return ``given`` as an ``Uncertainty``: parse a text such as ``"gaps_m=0.5"``, and return None for None.

    Raises ``InvalidInput`` if ``given`` is not an ``Uncertainty``, a text or None.
    """
    if given is None or isinstance(given, Uncertainty):
        return given
    if isinstance(given, str):
        return parse_uncertainty(given)
    raise InvalidInput(
        f"uncertainty = {given!r}: must be an Uncertainty or a text, for instance {UNCERTAINTY_EXAMPLE!r}"
    )


def mode_uncertainty(mode: str, given: object, where: str) -> Uncertainty | None:
    """Return ``checked_uncertainty(given)`` if it fits the shield mode ``mode``.

    Raises ``InvalidInput`` if mode ``robust`` has no uncertainty, or another mode has one; ``where`` is the beginning
    of the error message.
    """
    uncertainty = checked_uncertainty(given)
    if (mode == "robust") != (uncertainty is not None):
        needed = f"needs a value of uncertainty, for instance {UNCERTAINTY_EXAMPLE}"
        what = needed if uncertainty is None else "does not use uncertainty; use mode robust, or leave uncertainty out"
        raise InvalidInput(f"{where}: mode {mode} {what}")
    return uncertainty
