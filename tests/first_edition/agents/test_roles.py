"""A role of a scenario is the same agent as a driver of that vehicle: the same bits, or the same refusal."""

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.agents import registry
from ethbrake_marl.first_edition.agents.driving import Episodes, script_agents
from ethbrake_marl.first_edition.agents.protocol import Team
from ethbrake_marl.first_edition.agents.registry import agent_names
from tests.first_edition.rest.fixture_policies import make_policy

SCENARIOS = (
    "paper-random", "paper-random-buildup", "paper-random-obstacle", "paper-delay-high", "mixture-trucks",
    "realistic-truck-buildup", "standards-ccrm", "cooperation-1-front", "cooperation-3-congested",
    "cooperation-2-five",
)  # fmt: skip
SPECS = {
    "coast": ["coast"],
    "constant": ["constant:3"],
    "e_v2x_bm": ["e_v2x_bm", "e_v2x_bm:pairwise"],
    "full_brake": ["full_brake"],
    "policy": ["policy@mine", "policy@team", "policy"],
    "ppo": ["ppo", "ppo@mine"],
    "ppo-obstacle": ["ppo-obstacle"],
    "rollout-obstacle": ["rollout-obstacle"],
    "sac": ["sac", "sac@mine"],
    "team": ["team@team", "team@mine"],
    "universal": ["universal", "universal@mine"],
    "vine-all": ["vine-all"],
    "vine-front": ["vine-front"],
    "vine-pair": ["vine-pair"],
    "vine-preference": ["vine-preference"],
    "theirs": ["theirs:2@mine"],
}


def theirs(argument, settings):
    """An agent of somebody else's that reads everything that it is handed."""
    share = float(argument) / settings.needed_scenario().horizon_s + settings.time_step_s
    assert settings.policy == "mine" and settings.horizon_s == settings.scenario.horizon_s
    return eb.policy_agent(lambda seen: -share * np.abs(seen[:, :1]), name=settings.spec, clip=True)


@pytest.fixture(autouse=True, scope="module")
def _their_agents(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("roles"))
        patch.setattr(registry.AGENTS, "loaded", {})
        eb.register_agent("theirs", theirs, takes_policy=True)
        make_policy(eb.ObservationSpec(), {"name": "paper-random"}).save("mine")
        for vehicle in ("vehicle_2", "vehicle_3"):
            make_policy(eb.ObservationSpec(), {"name": "cooperation-3-pair"}).save(f"team/policy/{vehicle}")
        drivers = '{"vehicle_2": "policy/vehicle_2", "vehicle_3": "policy/vehicle_3"}'
        with open("team/team.json", "w", encoding="utf-8") as file:
            file.write(f'{{"scheme": "independent", "vehicles": 3, "drivers": {drivers}}}')
        yield


def scripted(name, vehicle_2):
    """A shipped scenario in which all but Vehicle 2 brake fully."""
    scenario = eb.load_scenario(name)
    return scenario.replace(roles={**dict.fromkeys(scenario.vehicle_names, "full_brake"), "vehicle_2": vehicle_2})


def outcome(worlds, scenario, make):
    """Harm and end of the worlds, where Vehicle 2 decides; or why not."""
    try:
        scripts = make()
        engine = eb.Engine(scenario, worlds.n, learners=(), scripts=scripts, deciders=(1,), worlds=worlds)
        final = Episodes.of(engine, worlds).final
    except eb.EthBrakeError as error:
        return str(error)
    parts = (engine.ledger.world_harm("total"), final.time_s, final.speeds_mps, final.gaps_m, final.command_mps2)
    return [part.tolist() for part in parts]


@pytest.mark.usefixtures("core_alone")
def test_specs__are_of_every_kind_of_agent():
    assert SPECS.keys() - {"theirs"} == set(agent_names())


@pytest.mark.parametrize("kind", SPECS)
@pytest.mark.parametrize("name", SCENARIOS)
def test_role__is_the_same_agent_as_a_driver(name, kind):
    check_role(name, SPECS[kind])


def check_role(name, specs):
    driven = scripted(name, "learner")
    worlds = driven.sample(2, 7).worlds
    for spec in specs:

        def as_driver(spec=spec):
            team = Team.of(eb.make_agent(spec, scenario=driven), (1,))
            return {**script_agents(driven), **team.drivers}

        role = scripted(name, spec)
        assert outcome(worlds, role, lambda role=role: script_agents(role)) == outcome(worlds, driven, as_driver), spec


@pytest.mark.parametrize("name", ["paper-random-buildup", "paper-random-obstacle"])
def test_role__does_what_a_driver_does_in_an_evaluation(name):
    """Another vehicle is driven as its script says: its decisions split the steps elsewhere, so not to the last bit."""
    harm = [
        eb.evaluate(agents=agents, scenario=scripted(name, role), episodes=20, vehicle=vehicle).outcome("driver")
        for role, vehicle, agents in (
            ("learner", 1, {"driver": eb.make_agent("universal", scenario=name)}),
            ("universal", 2, {"driver": eb.make_agent("full_brake")}),
        )
    ]
    assert harm[0].total_harm == pytest.approx(harm[1].total_harm, abs=1e-9)


@pytest.mark.parametrize("around", ["+episode", "+step"])
def test_role__has_nothing_around_it(around):
    """Two that roll themselves out would ask each other for ever, and a shield stands around the controlled vehicle."""
    check_nothing_around("e_v2x_bm:pairwise", around)


def check_nothing_around(spec, around):
    with pytest.raises(InvalidInput) as caught:
        script_agents(scripted("paper-random", f"{spec}{around}"))
    assert str(caught.value) == (
        f"agent '{spec}{around}': a vehicle that does not learn cannot have a search or a shield; give vehicle_2 the"
        f" role {spec}, or make it a learner"
    )


def test_role__is_no_team_behind_a_shield():
    eb.register_agent("behind", lambda argument, settings: eb.make_agent("coast+step", scenario="paper-random").on([1]))
    with pytest.raises(InvalidInput, match="'behind': a vehicle that does not learn cannot have a search or"):
        script_agents(scripted("paper-random", "behind"))
