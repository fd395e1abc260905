"""Readings of the paper: the parameters of its worlds, and three counts of the harm of the same episodes.

The paper says that "the harm associated with each pairwise collision is counted only once", and does not say what
happens after the first impact. Three counts are possible:

- ``ours``: the episode goes on, and each pair counts its first impact. This is the count of this package.
- ``R1``: the episode ends with the first impact of the line, at that moment, and only this impact counts.
- ``R2``: each pair counts its first contact as if the other pair did not exist: no impact changes a speed.

**Theorem.** Let H* be the pairwise harm of E-V2X-BM, the least sum of both pairs' squared closing speeds over all
constant decelerations. Under R1 and R2 the paper's hybrid does at most H* in every world.

Proof. Until the first impact of the line no vehicle feels another one, so up to there the motion, and the closing
speed of that impact, is that of independent pairs. Under R2 this holds for both pairs, and the harm of E-V2X-BM is H*
by its definition. Under R1 its harm is one of the two terms of H*, so at most H*. The hybrid drives as the policy where
the policy's harm is at most H*, and as E-V2X-BM elsewhere. QED. In our count an impact changes the speeds with which
the other pair meets, and nothing bounds the harm by H*.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from ethbrake_marl.worlds.catalogue import load_scenario
from ethbrake_marl.worlds.scenario import Scenario

RANDOM = "paper-random"
OURS, R1, R2 = READINGS = "ours", "R1", "R2"


class Reading(NamedTuple):
    """Parameters of worlds. Defaults are those that the paper states."""

    base: str = RANDOM  # name of the scenario, of three vehicles
    acts_s: float | None = None  # when Vehicle 2 acts (s since the alert); None: the latency of the scenario
    step_s: float | None = None  # time step (s) of the paper's map, with impacts at samples; None: exact impacts
    others: tuple[tuple[str, Any], ...] = ()  # other keys of the scenario, and their values

    def scenario(self) -> Scenario:
        scenario = load_scenario(self.base)
        keys = dict(self.others)
        if self.acts_s is not None:
            latency_s = [*scenario.model_dump()["latency_s"]]
            latency_s[1] = self.acts_s
            keys["latency_s"] = latency_s
        if self.step_s is not None:
            keys |= {"physics": "paper-map", "time_step_s": self.step_s}
        return scenario.replace(**keys)


STATED = Reading()
