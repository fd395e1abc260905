"""Agents and shields that this extension registers: the shield ``+robust``, and ``:estimated`` variants of other agents
and shields.

Arguments that several functions share: ``policy`` is the agent to shield, and ``argument`` a setting from the agent's
spec (the text that names the agent). Error messages quote ``settings.spec``.
"""

from __future__ import annotations

from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.certified.estimating_agents import Estimating, EstimatingHybrid
from ethbrake_marl.extensions.certified.options import RobustOptions, mode_uncertainty
from ethbrake_marl.extensions.certified.uncertainty import UNCERTAINTY_EXAMPLE
from ethbrake_marl.first_edition.agents.e_v2x_bm.coupled import make_e_v2x_bm
from ethbrake_marl.first_edition.agents.protocol import Agent, Driver, Source, Team
from ethbrake_marl.first_edition.agents.settings import AgentSettings
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver, shielded
from ethbrake_marl.first_edition.shields.factories import shield_episodes
from ethbrake_marl.registry import Part


def shield_robustly(policy: Agent, argument: str | None, settings: AgentSettings) -> Driver:
    """Return the shield ``+robust`` around ``policy``.

    The shield certifies actions in the corners of the box of possible worlds, not between them. ``argument`` is not
    used.
    """
    where = f"agent {settings.spec!r}"
    return ShieldedDriver(
        policy, settings.needed_scenario(), mode="robust", harm_count=settings.harm_count, where=where,
        uncertainty=mode_uncertainty("robust", settings.uncertainty, where),
    )  # fmt: skip


def shield_robustly_as_estimated(policy: Agent, argument: str | None, settings: AgentSettings) -> Driver:
    """Return the shield ``+robust:estimated``.

    The shield certifies actions in the estimated world, and in the corners of the ranges of the quantities that its
    vehicle did not receive, not between these corners. ``argument`` is not used.
    """
    return ShieldedDriver(
        policy, settings.needed_scenario(), mode="robust", harm_count=settings.harm_count,
        where=f"agent {settings.spec!r}", estimated=True,
    )  # fmt: skip


def shield_steps_as_estimated(policy: Driver, argument: str | None, settings: AgentSettings) -> Driver:
    """Return the shield ``+step:estimated``, which certifies every action of ``policy`` in the estimated world.

    ``argument`` is not used. Raises ``InvalidInput`` if ``policy`` is a team or if the scenario has several learners.
    """
    scenario = settings.needed_scenario()
    if isinstance(policy, Team) or len(scenario.learners) > 1:
        raise InvalidInput(
            f"agent {settings.spec!r}: :estimated can shield only one learner; to shield several learners, use +step"
        )
    return shielded(policy, scenario, "step", harm_count=settings.harm_count, estimated=True)


def shield_episodes_as_estimated(policy: Agent, argument: str | None, settings: AgentSettings) -> Agent:
    """Return the shield ``+episode:estimated`` or ``+episode:pairwise:estimated``: the paper's Algorithm 1 in the
    estimated world.

    At the first decision the shield predicts, in the estimated world, the harm of ``policy`` and of E-V2X-BM. The one
    with less predicted harm controls the vehicle for the whole episode. ``argument`` is ``pairwise`` for the pairwise
    form of E-V2X-BM, None for the coupled form. Raises ``InvalidInput`` if the name of ``policy`` already
    ends in ``:estimated``.
    """
    hybrid = shield_episodes(policy, argument, settings)
    if isinstance(policy, Estimating):
        raise InvalidInput(
            f"agent {settings.spec!r}: {policy.name} already decides only on received information, so a second"
            " :estimated has no effect; shield this agent with +step"
        )
    return EstimatingHybrid(hybrid, settings.needed_scenario())


def make_estimating_e_v2x_bm(argument: str | None, settings: AgentSettings) -> Agent:
    """Return the agent ``e_v2x_bm:estimated`` or ``e_v2x_bm:pairwise:estimated``: E-V2X-BM in the estimated world.

    ``argument`` is ``pairwise`` for the pairwise form of E-V2X-BM, or None for the coupled form.
    """
    return Estimating(make_e_v2x_bm(argument, settings), settings.needed_scenario())


ROBUST = Part(
    shield_robustly,
    form="+robust",
    about="as +step for uncertain quantities: certified in the corners of their intervals, not between them",
    knows=Source.MODEL,
    needs={"uncertainty": UNCERTAINTY_EXAMPLE},
    options=RobustOptions,
)

ESTIMATED_ROBUST = Part(shield_robustly_as_estimated, about="in the corners of the ranges of what was not received")

ESTIMATED_STEP = Part(shield_steps_as_estimated, about="certified in the estimated world")

ESTIMATED_EPISODE = Part(shield_episodes_as_estimated, about="predicted in the estimated world")

ESTIMATED_E_V2X_BM = Part(
    make_estimating_e_v2x_bm, about="computed from received information and the scenario's ranges"
)
