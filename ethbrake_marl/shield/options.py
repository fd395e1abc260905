"""The options of a shield around an interface, and their checks, the same for every interface."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from ethbrake_marl.errors import InvalidInput, unknown_name
from ethbrake_marl.harm import HarmCount
from ethbrake_marl.shield.agents import Bound
from ethbrake_marl.shield.alert import CAPS, Cap
from ethbrake_marl.shield.interior import CORNERS, INTERIOR, checked_robust
from ethbrake_marl.shield.settings import check_amount
from ethbrake_marl.shield.uncertainty import Uncertainty, mode_uncertainty

MODES = ("episode", "step", "robust")


@dataclass(frozen=True, slots=True)
class ShieldOptions:
    """The settings of ``HybridShield``, ``ShieldedEnv``, ``ShieldedVectorEnv`` and ``ShieldedVecEnv``: their keywords.

    Args:
        mode: ``episode`` (Algorithm 1: policy or E-V2X-BM for a whole episode), ``step`` (each action is certified or
            replaced) or ``robust`` (``step`` against an uncertainty). None: ``robust`` with an uncertainty, else
            ``step``.
        bound: the ``H*`` of mode ``episode``, ``coupled`` or the paper's ``pairwise``.
        harm_count: the harm that is guaranteed, ``first`` or ``total``.
        allowance: how far above the bound is allowed, m2/s2; not in mode ``episode``.
        uncertainty: what mode ``robust`` does not know, such as ``"gaps_m=0.5"``.
        cap: ``baseline``: no vehicle ever bears more harm than it would under the constants of least harm, whose sum is
            the bound at the alert. None: the sum alone is bounded. Mode ``step`` alone.
        robust: what mode ``robust`` certifies of an uncertainty: its ``corners`` (fast), or its whole ``interior``.
        believed: certify on what the vehicle received, mode ``robust`` against all that it did not. Modes ``step`` and
            ``robust`` of one learner, without ``uncertainty``, ``allowance``, ``cap``, ``logging`` and ``shares``.
        intervention_penalty: taken off the reward of a step in which something else than the proposal was applied.
        logging: keep every intervention in ``shield.log``; not in mode ``episode``.
        shares: tell in ``infos`` what each vehicle itself bears under the plan held now, and under the baseline plan;
            with a ``cap`` it is told always. Costs a few percent of a step; not in mode ``episode``.
        where: who is given them, for messages.

    Raises ``InvalidInput`` naming the setting that does not fit, ``UnknownName`` for a mode.

    >>> import ethbrake_marl as eb
    >>> eb.ShieldOptions(uncertainty="gaps_m=0.5").mode
    'robust'

    """

    mode: str | None = None
    bound: Bound = "coupled"
    harm_count: HarmCount = "first"
    allowance: float = 0.0
    uncertainty: Uncertainty | str | None = None
    cap: Cap | None = None
    robust: str = CORNERS
    believed: bool = False
    intervention_penalty: float = 0.0
    logging: bool = False
    shares: bool = False
    where: str = field(default="shield", compare=False)

    def __post_init__(self) -> None:
        mode = self.mode if self.mode is not None else "step" if self.uncertainty is None else "robust"
        if mode not in MODES:
            raise unknown_name("shield mode", mode, MODES)
        for name in ("believed", "logging", "shares"):
            if not isinstance(getattr(self, name), bool):
                raise InvalidInput(f"{self.where}: {name} = {getattr(self, name)!r}: must be True or False")
        if self.believed:
            self._check_believed(mode)
        uncertainty = None if self.believed else mode_uncertainty(mode, self.uncertainty, self.where)
        given = [name for name in ("allowance", "logging", "shares") if getattr(self, name)]
        if mode == "episode" and given:
            name = given[0]
            raise InvalidInput(
                f"{self.where}: {name} = {getattr(self, name)!r}: mode episode takes none; step and robust do"
            )
        if mode != "episode" and self.bound != "coupled":
            raise InvalidInput(f"{self.where}: bound = {self.bound!r}: mode {mode} takes none; episode does")
        if self.cap is not None and (mode != "step" or self.cap not in CAPS):
            allowed = "mode step alone takes one" if self.cap in CAPS else f"must be {', '.join(CAPS)} or None"
            raise InvalidInput(f"{self.where}: cap = {self.cap!r}: {allowed}")
        if checked_robust(self.robust, self.where) == INTERIOR and mode != "robust":
            raise InvalidInput(f"{self.where}: robust = {self.robust!r}: mode {mode} takes none; robust does")
        check_amount("intervention_penalty", self.intervention_penalty, self.where)
        object.__setattr__(self, "mode", mode)
        object.__setattr__(self, "uncertainty", uncertainty)

    def _check_believed(self, mode: str) -> None:
        """Raise ``InvalidInput`` for what a shield on what was received does not take."""
        if mode == "episode":
            raise InvalidInput(f"{self.where}: believed = True: mode episode takes none; step and robust do")
        without = {"uncertainty": None, "allowance": 0.0, "cap": None, "logging": False, "shares": False}
        for name, value in without.items():
            if getattr(self, name) != value:
                raise InvalidInput(
                    f"{self.where}: {name} = {getattr(self, name)!r}: not together with believed = True, which"
                    " certifies against what was not received"
                )


def read_options(where: str, given: Mapping[str, Any]) -> ShieldOptions:
    """The options of an interface's keywords; raises ``UnknownName`` for one that is none."""
    known = {each.name for each in fields(ShieldOptions)} - {"where"}
    for name in given:
        if name not in known:
            raise unknown_name(f"{where} option", name, known)
    return ShieldOptions(**given, where=where)
