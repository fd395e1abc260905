"""Build the agents of an evaluation from their specs, the texts that name agents on the command line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ethbrake_marl.errors import AgentFailed, InvalidInput
from ethbrake_marl.first_edition.agents.driving import episode_engine, script_agents
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.agents.protocol import Agent, Driver, Team
from ethbrake_marl.first_edition.agents.registry import agents_of_group, settings_needed, shields_with
from ethbrake_marl.first_edition.agents.spec import parse_spec, split_specs
from ethbrake_marl.first_edition.engine.memory import ask_script, begin_script
from ethbrake_marl.first_edition.evaluation.familiar import warn_unfamiliar
from ethbrake_marl.first_edition.game.harm import HarmCount
from ethbrake_marl.first_edition.physics.state import Worlds
from ethbrake_marl.first_edition.scenario.schema import Scenario


def check_agents(agents: Mapping[str, Driver], worlds: Worlds, scenario: Scenario, *, warn: bool = False) -> None:
    """Let every agent decide once, so that an error in an agent is raised before a long evaluation.

    An agent whose commands do not depend on the state (``state_free``) decides in all worlds. Other agents decide only
    in the first world. With ``warn``, also call ``warn_unfamiliar``.
    """
    if warn:
        warn_unfamiliar(agents, worlds, scenario, scenario.learners)
    for name, agent in agents.items():
        team = Team.of(agent, scenario.learners)
        scripts = script_agents(scenario, except_for=team.drivers)
        if team.shield is not None:
            with AgentFailed.naming(name, [script.name for script in scripts.values()]):
                episode_engine(worlds.take([0]), team, scenario).step({})
            continue
        for vehicle, driver in team.drivers.items():
            tried = worlds if getattr(driver, "state_free", False) else worlds.take([0])
            with AgentFailed.naming(name, [script.name for script in scripts.values()]):
                ask_script(driver, tried, begin_script(driver, tried, vehicle, scripts), vehicle)


def make_lineup(
    specs: str | Sequence[str],
    scenario: Scenario,
    *,
    harm_count: HarmCount = "first",
    uncertainty: object = None,
    alone: bool = False,
    bare: bool = False,
) -> dict[str, Driver]:
    """Build one agent for each text in ``specs``, and return a dictionary: text -> agent.

    Args:
        specs: a list, or one text with commas between the specs. The name of a group of agents, such as ``ladder``, is
            replaced by all agents of the group.
        scenario: scenario whose learners the agents drive.
        harm_count: count of harm that optimising agents minimise.
        uncertainty: for shields that need it: how far quantities may differ from their stated values, written as in
            ``gaps_m=0.5`` (``make_agent``).
        alone: whether to refuse teams.
        bare: whether to refuse agents that already have a shield and, if the scenario has one learner, also teams.

    Raises ``InvalidInput`` for a repeated spec, for an uncertainty that is missing or unused, and for a team or shield
    that is refused. Also raises the errors of ``make_agent``.

    """
    listed = split_specs(specs) if isinstance(specs, str) else specs
    specs = [each for spec in listed for each in agents_of_group(spec) or (spec,)]
    written = [parse_spec(spec) for spec in specs]
    for k, each in enumerate(written):
        if each in written[:k]:
            raise InvalidInput(f"agent {str(each)!r} is listed twice; list each agent once")
    if uncertainty is not None and not any("uncertainty" in settings_needed(each.shield) for each in written):
        using = "".join(f"; agents with +{shield} use it: ppo@PATH+{shield}" for shield in shields_with("uncertainty"))
        raise InvalidInput(f"uncertainty {uncertainty}: none of the agents uses this setting{using}")
    lineup = {
        str(each): make_agent(str(each), scenario=scenario, harm_count=harm_count, uncertainty=uncertainty)
        for each in written
    }
    for spec, agent in lineup.items():
        if isinstance(agent, Team) and (alone or (bare and len(scenario.learners) == 1)):
            raise InvalidInput(
                f"agent {spec!r} is a team, but this command needs an agent of one vehicle, for instance"
                " ppo@RUN/policy/vehicle_2"
            )
        if bare and parse_spec(spec).shield is not None:
            raise InvalidInput(
                f"agent {spec!r} already has a shield, and this command adds its own; name the agent without a shield,"
                " for instance ppo@PATH"
            )
    return lineup


def make_agents(specs: Sequence[str], scenario: Scenario, *, harm_count: HarmCount = "first") -> dict[str, Agent]:
    """Return the result of ``make_lineup``; raise ``InvalidInput`` if a spec names a team."""
    return make_lineup(specs, scenario, harm_count=harm_count, alone=True)  # type: ignore[return-value]  # no teams
