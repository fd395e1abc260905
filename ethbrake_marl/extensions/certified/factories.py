"""Agents and shields that this extension registers: the shield ``+robust``, and ``:estimated`` variants of other agents
and shields.
"""

from __future__ import annotations

from ethbrake_marl.agents.e_v2x_bm.coupled import make_e_v2x_bm
from ethbrake_marl.agents.protocol import Agent, Driver, Source, Team
from ethbrake_marl.agents.settings import AgentSettings
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.extensions.certified.enclosure import CORNERS, checked_robust
from ethbrake_marl.extensions.certified.estimating_agents import Estimating, EstimatingHybrid
from ethbrake_marl.extensions.certified.options import RobustOptions, mode_uncertainty
from ethbrake_marl.extensions.certified.uncertainty import UNCERTAINTY_EXAMPLE
from ethbrake_marl.registry import Part
from ethbrake_marl.shields.drivers import ShieldedDriver, shielded
from ethbrake_marl.shields.factories import shield_episodes


def shield_robustly(policy: Agent, argument: str | None, settings: AgentSettings) -> Driver:
    """Return the shield ``+robust`` or ``+robust:interior`` around ``policy``.

    The uncertainty is an interval around each uncertain quantity; together the intervals form a box of possible worlds.
    The shield certifies actions for the corners of this box, or for its whole interior.

    Args:
        policy: the agent to shield.
        argument: worlds of the box in which the shield certifies actions: ``corners`` or ``interior``; None means
            ``corners``.
        settings: settings of the agent: its scenario, uncertainty and harm count, and its spec (the text that names the
            agent), which error messages quote.

    """
    where = f"agent {settings.spec!r}"
    robust, uncertainty = checked_robust(argument or CORNERS, where), settings.uncertainty
    return ShieldedDriver(
        policy, settings.needed_scenario(), mode="robust", harm_count=settings.harm_count, where=where, robust=robust,
        uncertainty=mode_uncertainty("robust", uncertainty, where),
    )  # fmt: skip


def shield_robustly_as_estimated(policy: Agent, argument: str | None, settings: AgentSettings) -> Driver:
    """Return the shield ``+robust:estimated`` or ``+robust:interior:estimated``.

    The shield certifies actions in the estimated world, and also for other values of the quantities that its vehicle
    did not receive, within the ranges of these quantities.

    Args:
        policy: the agent to shield.
        argument: worlds of the box in which the shield certifies actions: ``corners`` or ``interior``; None means
            ``corners``.
        settings: settings of the agent: its scenario, its harm count, and its spec (the text that names the agent),
            which error messages quote.

    """
    where = f"agent {settings.spec!r}"
    return ShieldedDriver(
        policy, settings.needed_scenario(), mode="robust", harm_count=settings.harm_count, where=where,
        robust=checked_robust(argument or CORNERS, where), estimated=True,
    )  # fmt: skip


def shield_steps_as_estimated(policy: Driver, argument: str | None, settings: AgentSettings) -> Driver:
    """Return the shield ``+step:estimated``, which certifies every action of ``policy`` in the estimated world.

    Raises ``InvalidInput`` if ``policy`` is a team or if the scenario has several learners.

    Args:
        policy: the agent to shield.
        argument: not used.
        settings: settings of the agent: its scenario, its harm count, and its spec (the text that names the agent),
            which error messages quote.

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

    At the first decision the shield predicts, in the estimated world, the harm of ``policy`` and of E-V2X-BM (the best
    constant deceleration). The policy or E-V2X-BM, whichever has less predicted harm, controls the vehicle for the
    whole episode.

    Raises ``InvalidInput`` if ``policy`` already decides on received information.

    Args:
        policy: the agent that the shield compares with E-V2X-BM.
        argument: ``pairwise`` for the pairwise form of E-V2X-BM, None for the coupled form.
        settings: settings of the agent: its scenario, its harm count, and its spec (the text that names the agent),
            which error messages quote.

    """
    hybrid = shield_episodes(policy, argument, settings)
    if isinstance(policy, Estimating):
        raise InvalidInput(
            f"agent {settings.spec!r}: {policy.name} already decides only on received information, so a second"
            " :estimated has no effect; shield this agent with +step"
        )
    return EstimatingHybrid(hybrid, settings.needed_scenario())


def make_estimating_e_v2x_bm(argument: str | None, settings: AgentSettings) -> Agent:
    """Return the agent ``e_v2x_bm:estimated`` or ``e_v2x_bm:pairwise:estimated``.

    The agent is E-V2X-BM (the best constant deceleration) in the estimated world. ``argument`` is ``pairwise`` for the
    pairwise form of E-V2X-BM, or None for the coupled form. ``settings`` contains the scenario of the worlds.
    """
    return Estimating(make_e_v2x_bm(argument, settings), settings.needed_scenario())


ROBUST = Part(
    shield_robustly,
    form="+robust[:interior]",
    about="as +step for uncertain quantities: certified in the corners of their intervals; interior: in all worlds",
    knows=Source.MODEL,
    needs={"uncertainty": UNCERTAINTY_EXAMPLE},
    options=RobustOptions,
)

ESTIMATED_ROBUST = Part(shield_robustly_as_estimated, about="for all quantities that were not received")

ESTIMATED_STEP = Part(shield_steps_as_estimated, about="certified in the estimated world")

ESTIMATED_EPISODE = Part(shield_episodes_as_estimated, about="predicted in the estimated world")

ESTIMATED_E_V2X_BM = Part(
    make_estimating_e_v2x_bm, about="computed from received information and the scenario's ranges"
)
