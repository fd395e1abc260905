"""E-V2X-BM as an agent: one constant deceleration, chosen at the alert."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np

from ethbrake_marl.agents.believing import Believing, split_believed
from ethbrake_marl.agents.e_v2x_bm.coupled import optimise_coupled
from ethbrake_marl.agents.e_v2x_bm.pairwise import optimise_pairwise
from ethbrake_marl.agents.knowledge import Source
from ethbrake_marl.agents.protocol import Agent, fixed_commands, place, recall
from ethbrake_marl.agents.registry import AgentSettings
from ethbrake_marl.engine.stream import Script, is_state_free
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.harm import HarmCount, check_harm_count
from ethbrake_marl.physics import Floats, Ints, Worlds

Mode = Literal["coupled", "pairwise"]


class EV2XBM:
    """The constant deceleration of least harm.

    ``coupled`` minimises the harm realised in the engine's physics until ``horizon_s`` under ``harm_count``, the
    ``others`` following their scripts, and all vehicles that are not in there (learners) braking fully. ``pairwise``
    is the paper's closed form: everybody else brakes fully, and no velocities are exchanged. ``predicted_harm`` [n] is
    what each of them expects (m2/s2). Raises ``InvalidInput`` for an unknown mode or count, and, when an episode
    begins, in ``coupled`` mode for another vehicle's script whose command is not fixed at the alert.
    """

    def __init__(self, mode: Mode = "coupled", *, harm_count: HarmCount = "first", horizon_s: float = 8.0) -> None:
        if mode not in ("coupled", "pairwise"):
            raise InvalidInput(f"e_v2x_bm mode {mode!r}: must be 'coupled' or 'pairwise'")
        check_harm_count(harm_count)
        self.name = "e_v2x_bm" if mode == "coupled" else "e_v2x_bm:pairwise"
        self.knows = Source.MODEL if mode == "coupled" else Source.STATE
        self.predicted_harm: Floats = np.empty(0)
        self.deceleration_mps2: Floats = np.empty(0)  # a* [n]
        self.others: Mapping[int, Script] = {}
        self._mode = mode
        self._harm_count = harm_count
        self._horizon_s = horizon_s

    def begin(self, worlds: Worlds, vehicle: int, rows: Ints) -> None:
        """Choose a* for these rows' episodes from their worlds at the alert."""
        if self._mode == "pairwise":
            closed = optimise_pairwise(worlds, vehicle)
            best, harm = closed.deceleration_mps2, closed.harm
        else:
            others = self._others_mps2(worlds, vehicle)
            coupled = optimise_coupled(
                worlds, vehicle, harm_count=self._harm_count, horizon_s=self._horizon_s, others_mps2=others
            )
            best, harm = coupled.deceleration_mps2, coupled.harm
        self.deceleration_mps2 = place(self.deceleration_mps2, rows, best)
        self.predicted_harm = place(self.predicted_harm, rows, harm)

    def act(self, worlds: Worlds, vehicle: int) -> Floats:
        """``-a*``, [n] m/s2."""
        return -recall(self.deceleration_mps2, worlds.n, self.name)

    def decides_before(self, vehicle: int) -> bool:
        """Whether the choice does not wait for that of ``vehicle``."""
        return self._mode == "pairwise" or vehicle not in self.others

    def _others_mps2(self, worlds: Worlds, vehicle: int) -> Floats:
        """What every vehicle will do, [n, N] m/s2; only the columns of the others are meant."""

        def is_fixed(script: Script) -> bool:
            return is_state_free(script) or (isinstance(script, EV2XBM) and script.decides_before(vehicle))

        advice = (
            f" before vehicle_{vehicle + 1} chooses; take e_v2x_bm:pairwise, which needs nobody's command, for one of"
            " the two"
        )
        who = f"agent {self.name!r}"
        return fixed_commands(self.others, worlds, who, vehicle=vehicle, is_fixed=is_fixed, advice=advice)


def make_e_v2x_bm(argument: str | None, settings: AgentSettings) -> Agent:
    """``e_v2x_bm``, the same as ``e_v2x_bm:coupled``, or ``e_v2x_bm:pairwise``; ``:believed`` behind: believing."""
    mode, believes = split_believed(argument)
    if mode not in (None, "coupled", "pairwise"):
        raise InvalidInput(f"agent {settings.spec!r}: the argument must be 'coupled' or 'pairwise', then 'believed'")
    agent = EV2XBM(
        "pairwise" if mode == "pairwise" else "coupled", harm_count=settings.harm_count, horizon_s=settings.horizon_s
    )
    return Believing(agent, settings.needed_scenario()) if believes else agent
