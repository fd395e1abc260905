"""Factories of what the registry puts around an agent: the shields, with and without ``:believed``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ethbrake_marl.agents.protocol import Agent, Driver, Knowledge, Source, Team
from ethbrake_marl.agents.registry import AgentSettings
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.certified.enclosure import CORNERS, checked_robust
from ethbrake_marl.extensions.certified.estimating_agents import Believing
from ethbrake_marl.extensions.certified.uncertainty import UNCERTAINTY_EXAMPLE
from ethbrake_marl.physics.state import Vehicles, Worlds
from ethbrake_marl.registry import Part
from ethbrake_marl.shield.drivers import ShieldedDriver, shielded
from ethbrake_marl.shield.options import Bound, mode_uncertainty
from ethbrake_marl.shield.paper_hybrid import HybridAgent


class BelievingHybrid(Believing):
    """Algorithm 1 on what was received: at the first decision policy and E-V2X-BM are compared as is believed."""

    policy: HybridAgent

    @property
    def knows(self) -> Knowledge:
        """What the policy knows, which drives by what it observes, and what the comparison adds."""
        return Knowledge.of(self.policy.policy, also=Source.BELIEFS)

    def _shown_at_first(self, believed: Worlds) -> Worlds:
        """The comparison is a rollout, which begins at t = 0 without impacts: the same line, its clock put back."""
        v, n = believed.vehicles, believed.n
        latency = np.maximum(v.latency_s - believed.time_s[:, np.newaxis], 0.0)
        vehicles = Vehicles.at_once(
            v.braking_capacity_mps2, v.driving_capacity_mps2, latency, v.mass_t, v.speed_limit_mps, v.restitution,
            v.brake_rate_mps3, v.release_rate_mps3,
        )  # fmt: skip
        return replace(
            believed, vehicles=vehicles, time_s=np.zeros(n), pair_hit=np.zeros_like(believed.pair_hit),
            obstacle_hit=np.zeros(n, np.bool_),
        )  # fmt: skip


def shield_episodes(policy: Agent, argument: str | None, settings: AgentSettings) -> Agent:
    """``+episode`` or ``+episode:pairwise`` around an agent, with ``:believed`` behind on what was received."""
    bound: Bound = "coupled" if argument is None else "pairwise"
    scenario = settings.needed_scenario()
    hybrid = HybridAgent(policy, scenario, bound=bound, harm_count=settings.harm_count)
    if settings.believes and isinstance(policy, Believing):
        raise InvalidInput(f"agent {settings.spec!r}: {policy.name} decides on what was received itself; take +step")
    return BelievingHybrid(hybrid, scenario) if settings.believes else hybrid


def shield_steps(policy: Driver, argument: str | None, settings: AgentSettings) -> Driver:
    """``+step`` around an agent or a team, where several vehicles learn around a copy for each; ``+step:believed``."""
    scenario, believes = settings.needed_scenario(), settings.believes
    several = isinstance(policy, Team) or len(scenario.learners) > 1
    if several and believes:
        raise InvalidInput(f"agent {settings.spec!r}: :believed shields one learner, not several; take +step")
    return shielded(policy, scenario, "step", harm_count=settings.harm_count, believed=believes)


def shield_steps_robustly(policy: Agent, argument: str | None, settings: AgentSettings) -> Driver:
    """``+robust`` or ``+robust:interior``, against the uncertainty of the settings.

    With ``:believed`` behind, against all that was not received, without one.
    """
    where = f"agent {settings.spec!r}"
    return ShieldedDriver(
        policy, settings.needed_scenario(), mode="robust", harm_count=settings.harm_count, believed=settings.believes,
        where=where, robust=checked_robust(argument or CORNERS, where),
        uncertainty=None if settings.believes else mode_uncertainty("robust", settings.uncertainty, where),
    )  # fmt: skip


EPISODE = Part(
    shield_episodes,
    form="+episode[:pairwise][:believed]",
    about="behind Algorithm 1: it or E-V2X-BM drives the episode, whichever harms less; believed: as far as is"
    " received",
    knows=Source.MODEL,
)

STEP = Part(
    shield_steps,
    form="+step[:believed]",
    about="every action certified, or replaced; of a team together; believed: certified in the world that is believed",
    knows=Source.MODEL,
    teams=True,
)

ROBUST = Part(
    shield_steps_robustly,
    form="+robust[:interior][:believed]",
    about="as +step where not everything is known: in the corners of an uncertainty, interior: in all of it;"
    " believed: against all that was not received",
    knows=Source.MODEL,
    needs={"uncertainty": UNCERTAINTY_EXAMPLE},
)
