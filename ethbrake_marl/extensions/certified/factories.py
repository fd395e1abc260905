"""Registry entries of this extension: the shield ``+robust``, and the variant ``:estimated`` of agents and shields."""

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
    """Make the shield ``+robust`` or ``+robust:interior`` around ``policy``: it certifies actions in the corners or the
    whole interior of an uncertainty (an interval around each quantity).

    Args:
        policy: the agent to shield.
        argument: ``corners``, ``interior``, or None for ``corners``.
        settings: scenario, uncertainty, harm to bound, and the agent's spec for error messages.

    """
    where = f"agent {settings.spec!r}"
    robust, uncertainty = checked_robust(argument or CORNERS, where), settings.uncertainty
    return ShieldedDriver(
        policy, settings.needed_scenario(), mode="robust", harm_count=settings.harm_count, where=where, robust=robust,
        uncertainty=mode_uncertainty("robust", uncertainty, where),
    )  # fmt: skip


def shield_robustly_as_estimated(policy: Agent, argument: str | None, settings: AgentSettings) -> Driver:
    """Make the shield ``+robust:estimated`` or ``+robust:interior:estimated``.

    It is the same shield, for the ranges of what the vehicle did not receive.

    Args:
        policy: the agent to shield.
        argument: ``corners``, ``interior``, or None for ``corners``.
        settings: scenario, harm to bound, and the agent's spec for error messages.

    """
    where = f"agent {settings.spec!r}"
    return ShieldedDriver(
        policy, settings.needed_scenario(), mode="robust", harm_count=settings.harm_count, where=where,
        robust=checked_robust(argument or CORNERS, where), estimated=True,
    )  # fmt: skip


def shield_steps_as_estimated(policy: Driver, argument: str | None, settings: AgentSettings) -> Driver:
    """Make the shield ``+step:estimated``: every action of ``policy`` is certified in the estimated world.

    Raises ``InvalidInput`` for a team or several learners.

    Args:
        policy: the agent to shield.
        argument: not used.
        settings: scenario, harm to bound, and the agent's spec for error messages.

    """
    scenario = settings.needed_scenario()
    if isinstance(policy, Team) or len(scenario.learners) > 1:
        raise InvalidInput(
            f"agent {settings.spec!r}: :estimated shields one learner. +step shields several where messages contain"
            " every piece; without a piece several learners have no shield"
        )
    return shielded(policy, scenario, "step", harm_count=settings.harm_count, estimated=True)


def shield_episodes_as_estimated(policy: Agent, argument: str | None, settings: AgentSettings) -> Agent:
    """Make the shield ``+episode:estimated`` or ``+episode:pairwise:estimated``.

    It is the paper's Algorithm 1 in the estimated world.

    At the first decision it predicts the harm of ``policy`` and of E-V2X-BM (the best constant deceleration) in that
    world; the better one controls the whole episode.

    Raises ``InvalidInput`` for an agent that already decides on received information.

    Args:
        policy: the agent that E-V2X-BM is compared with.
        argument: ``pairwise`` or None.
        settings: scenario, and the agent's spec for error messages.

    """
    hybrid = shield_episodes(policy, argument, settings)
    if isinstance(policy, Estimating):
        raise InvalidInput(f"agent {settings.spec!r}: {policy.name} decides on what was received itself; take +step")
    return EstimatingHybrid(hybrid, settings.needed_scenario())


def make_estimating_e_v2x_bm(argument: str | None, settings: AgentSettings) -> Agent:
    """Make the agent ``e_v2x_bm:estimated`` or ``e_v2x_bm:pairwise:estimated``.

    It is E-V2X-BM (the best constant deceleration) in the estimated world.

    ``argument`` is ``pairwise`` or None; ``settings`` hold the scenario.
    """
    return Estimating(make_e_v2x_bm(argument, settings), settings.needed_scenario())


ROBUST = Part(
    shield_robustly,
    form="+robust[:interior]",
    about="as +step where not everything is known: in the corners of an uncertainty, interior: in all of it",
    knows=Source.MODEL,
    needs={"uncertainty": UNCERTAINTY_EXAMPLE},
    options=RobustOptions,
)

ESTIMATED_ROBUST = Part(shield_robustly_as_estimated, about="against all that was not received")

ESTIMATED_STEP = Part(shield_steps_as_estimated, about="certified in the estimated world")

ESTIMATED_EPISODE = Part(shield_episodes_as_estimated, about="as far as is received")

ESTIMATED_E_V2X_BM = Part(
    make_estimating_e_v2x_bm, about="on what was received, and the scenario's ranges for the rest"
)
