"""Agents by name, and whole episodes: who drives what, what each is told and sees, and whose memory is whose."""

import pickle

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.first_edition.agents.driving import Episodes, drive, episode_engine, script_agents
from ethbrake_marl.first_edition.agents.e_v2x_bm.coupled import optimise_coupled
from ethbrake_marl.first_edition.agents.e_v2x_bm.pairwise import optimise_pairwise
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.agents.protocol import Team
from ethbrake_marl.first_edition.agents.registry import agent_entries, agent_names, register_agent
from ethbrake_marl.first_edition.agents.spec import AgentSpec, parse_spec
from ethbrake_marl.first_edition.envs.making import make_engine
from ethbrake_marl.first_edition.evaluation.identity import worlds_sha256
from ethbrake_marl.first_edition.evaluation.motion import follow_episodes
from ethbrake_marl.first_edition.evaluation.record import record_episode
from ethbrake_marl.first_edition.evaluation.rollout import evaluate
from ethbrake_marl.first_edition.physics.state import Floats, Worlds
from ethbrake_marl.first_edition.policies.shipped import shipped_policies
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver
from ethbrake_marl.first_edition.shields.paper_hybrid import HybridAgent
from tests.first_edition.rest.fixture_asked import Asked

SCENARIO = eb.load_scenario("paper-random")
PAIR = eb.load_scenario("cooperation-3-pair")


def with_role(role, vehicle="vehicle_3"):
    return SCENARIO.replace(roles={**SCENARIO.roles, vehicle: role}, early_impacts="keep")


@pytest.mark.parametrize("spec", ["e_v2x_bm", "e_v2x_bm+episode"])
@pytest.mark.parametrize("role", ["constant:3", "coast", "e_v2x_bm"])
def test_e_v2x_bm__predicts_and_beats_constants_whatever_script_the_others_follow(spec, role):
    scenario = with_role(role)
    worlds = scenario.sample(60, 7).worlds
    episodes = drive(worlds, make_agent(spec, scenario=scenario), scenario, 1)
    realised = episodes.ledger.world_harm("first")
    np.testing.assert_allclose(realised, episodes.memories[1]["predicted_harm"], atol=1e-6)
    for deceleration in np.linspace(0.0, 7.0, 8):
        constant = drive(worlds, make_agent(f"constant:{deceleration}"), scenario, 1)
        assert (realised <= constant.ledger.world_harm("first") + 1e-6).all()


def test_e_v2x_bm__knows_who_drives_in_the_engines_of_all_interfaces():
    roles = {"vehicle_1": "learner", "vehicle_2": "e_v2x_bm", "vehicle_3": "constant:3"}
    scenario = SCENARIO.replace(roles=roles, early_impacts="keep", obstacle_gap_m=60)
    engine, alert = make_engine(scenario, 4, seed=3), scenario.sample(4, 3, channel="training").worlds
    agent, braking = make_agent("e_v2x_bm"), script_agents(SCENARIO, except_for=1)
    told, papers, alone = (agent.begin(alert, 1, scripts) for scripts in (script_agents(scenario), braking, {}))
    assert engine.memories[1]["deceleration_mps2"].tolist() == told["deceleration_mps2"].tolist()
    assert told["deceleration_mps2"].tolist() != alone["deceleration_mps2"].tolist()
    assert papers["deceleration_mps2"].tolist() == alone["deceleration_mps2"].tolist()


def test_drive__a_scripted_vehicle_that_is_driven_follows_its_script_in_nobodys_plan():
    plain = with_role("e_v2x_bm")
    overridden = plain.replace(roles=plain.roles | {"vehicle_2": "coast"})
    worlds = plain.sample(5, 7).worlds
    agent = make_agent("full_brake")
    found = [drive(worlds, agent, scenario, 1).ledger.world_harm("first") for scenario in (overridden, plain)]
    assert found[0].tolist() == found[1].tolist()


def test_drive__a_policy_as_a_role_does_what_it_does_when_it_is_driven():
    def with_roles(**roles):
        return SCENARIO.replace(early_impacts="keep", roles={"vehicle_1": "full_brake", **roles})

    universal, braking = make_agent("universal"), make_agent("full_brake")
    driven = with_roles(vehicle_2="learner", vehicle_3="full_brake")
    role = with_roles(vehicle_2="universal", vehicle_3="learner")
    both = with_roles(vehicle_2="learner", vehicle_3="learner")
    worlds = driven.sample(20, 7).worlds
    harm = drive(worlds, universal, driven, 1).ledger.world_harm("first")
    for episodes in (drive(worlds, braking, role, 2), drive(worlds, Team({1: universal, 2: braking}, "both"), both)):
        assert np.abs(episodes.ledger.world_harm("first") - harm).max() < 1e-9
    assert 0.0 < harm.mean() < drive(worlds, braking, driven, 1).ledger.world_harm("first").mean()


def test_drive__shows_every_part_of_a_step_within_which_nobody_decides(swinging):
    class Replay:
        def __init__(self, worlds):
            self.now, self.harm = worlds, np.zeros((worlds.n, 2))

        def see(self, before, command_mps2, until_s):
            assert np.array_equal(before.gaps_m, self.now.gaps_m) or np.allclose(before.gaps_m, self.now.gaps_m)
            self.now, impacts = eb.advance(before, command_mps2, until_s=until_s)
            self.harm += np.stack([impacts.first_impact_harm.sum(axis=1), impacts.total_harm.sum(axis=1)], axis=1)

    worlds = swinging.sample(30, 7).worlds
    replay = Replay(worlds)
    episodes = drive(worlds, make_agent("universal"), swinging, 1, watched_by=[replay])
    assert np.abs(replay.now.gaps_m - episodes.final.gaps_m).max() < 1e-9
    for k, count in enumerate(("first", "total")):
        assert np.abs(replay.harm[:, k] - episodes.ledger.world_harm(count)).max() < 1e-9
    assert episodes.ledger.world_harm("total").max() > 1.0


def test_record__and_motion_follow_scripts_that_decide_within_a_step(swinging):
    sample = swinging.sample(4, 7)
    agent = make_agent("constant:3")
    outcome = evaluate(sample, {"it": agent}, scenario=swinging).outcome("it")
    motions = follow_episodes(sample.worlds, agent, swinging)
    assert outcome.sampled_harm is None  # its samples are the decisions of Vehicle 2 alone
    for k, motion in enumerate(motions):
        record = record_episode(sample.worlds.take([k]), agent, scenario=swinging)
        for impacts in (record.impacts, motion.impacts):
            assert (impacts.closing_speed_mps**2).sum() == pytest.approx(outcome.total_harm[k])
        assert record.gaps_m[-1] == pytest.approx(outcome.final.gaps_m[k])


def test_evaluate__an_agent_alone_drives_every_learner_and_a_team_of_nobody_none():
    brake, gentle = make_agent("full_brake"), make_agent("constant:4")
    agents = {"alone": brake, "by_hand": Team({1: brake, 2: brake}, "t"), "unlike": Team({1: gentle, 2: brake}, "u")}
    level = eb.load_scenario("cooperation-0-sensors")
    scripted = {"scripts": Team({}, "scripts")}
    found, paper, nobody, driven = (
        evaluate(scenario.sample(60, 7), drivers, scenario=scenario, vehicle=vehicle)
        for scenario, drivers, vehicle in (
            (PAIR, agents, None),
            (SCENARIO, {"alone": brake, "unlike": gentle}, None),
            (level, scripted, None),
            (level, {"scripts": brake}, 1),
        )
    )
    for other, result, name in ((paper, found, "alone"), (paper, found, "unlike"), (driven, nobody, "scripts")):
        harms = [each.outcome(name).total_harm for each in (result, other)]
        np.testing.assert_allclose(*harms, rtol=1e-12)
    assert found.outcome("alone").total_harm.tolist() == found.outcome("by_hand").total_harm.tolist()
    assert found.vehicles == (1, 2)


def test_evaluate__one_agent_remembers_each_learner_apart_and_predicts_for_nobody():
    class Remembering:
        name = "remembering"

        def begin(self, alert, vehicle, scripts):
            assert set(scripts) == {0}
            return {"predicted_harm": np.full(alert.n, float(vehicle))}

        def act(self, worlds, memory, vehicle):
            assert (memory["predicted_harm"] == vehicle).all()
            return np.full(worlds.n, -3.0), memory

    assert evaluate(PAIR.sample(3, 0), {"m": Remembering()}, scenario=PAIR).outcome("m").predicted_harm is None


class _Writes:
    """Writes into what it is given, when an episode begins or at each decision."""

    knows = "own sensors"

    def __init__(self, when: str, *, state_free: bool) -> None:
        self.name, self.when, self.state_free = "kmh", when, state_free

    def begin(self, alert, vehicle, scripts):
        if self.when == "begin":
            alert.gaps_m[:] = 1000.0
        return np.zeros(alert.n)

    def act(self, worlds, memory, vehicle):
        memory += 1.0  # in its own copy
        if self.when in ("name", "plan"):
            setattr(self, self.when, "other")
        if self.when == "act":
            speeds = worlds.speeds_mps
            speeds *= 3.6  # a beginner's slip: km/h, in place
        if self.when == "vehicles":
            worlds.vehicles.mass_t[:] = 1.0
        return -worlds.vehicles.braking_capacity_mps2[:, vehicle], memory


WRAPPED = {
    "alone": lambda agent: agent,
    "episode": lambda agent: HybridAgent(agent, SCENARIO),
    "step": lambda agent: ShieldedDriver(agent, SCENARIO),
}


@pytest.mark.parametrize("around", WRAPPED)
@pytest.mark.parametrize("state_free", [True, False])
@pytest.mark.parametrize(
    ("when", "told"),
    [
        *((when, r"(begin|act) on .*read-only") for when in ("begin", "act", "vehicles")),
        *(
            (name, rf"the agent changed its attribute '{name}', .*: an agent with memory has begin\(alert, ")
            for name in ("name", "plan")  # an attribute that there is, and a new one
        ),
    ],
)
def test_agent_that_writes_into_worlds_or_itself__is_refused_by_name(
    around: str, when: str, told: str, state_free: bool
) -> None:
    sample = SCENARIO.sample(20, 3)
    before = worlds_sha256(sample.worlds, sample.index)
    agents = {"full_brake": make_agent("full_brake"), "kmh": WRAPPED[around](_Writes(when, state_free=state_free))}
    with pytest.raises(InvalidInput, match=rf"agent '(kmh|other)' of vehicle_2: {told}"):
        evaluate(sample, agents, scenario=SCENARIO)
    assert worlds_sha256(sample.worlds, sample.index) == before and sample.worlds.gaps_m.flags.writeable


# ---------------------------------------------------------------- the registry: one grammar, what each asks for


def asked(spec: str, worlds: Worlds, vehicle: int = 1, **settings) -> Floats:
    return Asked(make_agent(spec, **settings)).begin(worlds, vehicle).act(worlds, vehicle)


@pytest.mark.parametrize(
    ("spec", "parts"),
    [
        ("full_brake", AgentSpec("full_brake", None, None, ())),
        ("constant:-5+step", AgentSpec("constant", "-5", None, ("step",))),
        ("ppo+step", AgentSpec("ppo", None, None, ("step",))),
        ("ppo@runs/a+b:c@d+episode:pairwise", AgentSpec("ppo", None, "runs/a+b:c@d", ("episode:pairwise",))),
        ("ppo@runs/my+step/", AgentSpec("ppo", None, "runs/my+step/", ())),
        ("mine:x@path+step", AgentSpec("mine", "x", "path", ("step",))),
        ("mine:a+b", AgentSpec("mine", "a+b", None, ())),
    ],
)
def test_spec__is_taken_apart_and_written_again(spec, parts):
    assert parse_spec(spec) == parts and str(parts) == spec


@pytest.mark.parametrize(("spec", "kind"), [("full_brake+step", ShieldedDriver), ("constant:-5+step", ShieldedDriver)])
def test_shields__go_around_any_agent_and_hold(spec, kind):
    check_holds(spec, kind)


def check_holds(spec, kind, **settings):
    agents = {spec: make_agent(spec, scenario=SCENARIO, harm_count="total", **settings)}
    assert isinstance(agents[spec], kind)
    outcome = eb.evaluate(SCENARIO.sample(3, 5), agents, scenario=SCENARIO).outcome(spec)
    assert (outcome.total_harm <= outcome.predicted_harm + 1e-9).all()


@pytest.mark.parametrize(
    ("spec", "capacity", "expected"),
    [("full_brake", 7, -7.0), ("coast", 7, 0.0), ("constant:3.5", 7, -3.5), ("constant:-2", 7, 2.0)],
)
def test_scripts__ask_for_their_acceleration(spec, capacity, expected):
    worlds = SCENARIO.replace(braking_capacity_mps2=[6, capacity, 6]).sample(3, 7).worlds
    assert asked(spec, worlds).tolist() == [expected] * 3


def test_e_v2x_bm__drives_by_its_optimum_of_the_count_and_horizon_it_was_given():
    worlds = SCENARIO.sample(40, 31).worlds
    pairwise, closed = Asked(make_agent("e_v2x_bm:pairwise")).begin(worlds, 1), optimise_pairwise(worlds, 1)
    assert np.array_equal(pairwise.predicted_harm, closed.harm)
    assert np.array_equal(pairwise.act(worlds, 1), -closed.deceleration_mps2)
    for settings in ({"harm_count": "first"}, {"harm_count": "total"}, {"horizon_s": 1.5}):
        assert np.array_equal(asked("e_v2x_bm", worlds, **settings), -optimise_coupled(worlds, 1, **settings)[0])
        other = {"harm_count": "first", "horizon_s": 4.0}
        assert not np.array_equal(asked("e_v2x_bm", worlds, **settings), asked("e_v2x_bm", worlds, **other))
    short = SCENARIO.replace(horizon_s=4)  # whose horizon is the agent's
    assert np.array_equal(asked("e_v2x_bm", worlds, scenario=short), asked("e_v2x_bm", worlds, horizon_s=4.0))


@pytest.mark.parametrize(
    "spec",
    [*("full_brake", "coast", "constant:3.5", "e_v2x_bm", "e_v2x_bm:pairwise"), *("full_brake+episode", "ppo+episode")],
)
def test_agents__every_row_is_its_own_new_episodes_change_theirs_alone_and_agents_can_be_pickled(spec):
    check_rows(spec)


def check_rows(spec):
    worlds, fresh, rows, new = SCENARIO.sample(20, 3).worlds, SCENARIO.sample(2, 32).worlds, [17, 1], np.array([4, 0])
    agent = Asked(make_agent(spec, scenario=SCENARIO)).begin(worlds, 1)
    part, before = agent.take(rows), Asked(agent.agent, memory=agent.memory).act(worlds, 1)
    assert part.act(worlds.take(rows), 1).tolist() == before[rows].tolist()
    whole, some = (drive(each, agent.agent, SCENARIO, 1).ledger.total_harm for each in (worlds, worlds.take(rows)))
    assert some.tolist() == whole[rows].tolist()
    agent.begin(fresh, 1, new)
    before[new] = asked(spec, fresh, scenario=SCENARIO)
    again = Asked(pickle.loads(pickle.dumps(agent.agent)), memory=agent.memory)
    assert all(each.act(worlds.assign(new, fresh), 1).tolist() == before.tolist() for each in (again, agent))
    assert again.name == spec.removesuffix(":20" if "best" in spec else "")  # a budget is no part of that name


@pytest.mark.usefixtures("core_alone")
def test_agent_names__are_those_that_ship_and_are_listed(capsys):
    names = ("coast", "constant", "e_v2x_bm", "full_brake", "ppo", "sac", "policy", "universal", "team")
    names = (*names, *(name for name in shipped_policies() if name not in names))
    assert agent_names() == tuple(sorted(names)) and run_command(["agent", "list"]) == 0
    table = capsys.readouterr().out
    assert [name for name in (*names, "+episode", "+step") if name not in table] == []
    assert all(callable(entry.make) and entry.about and entry.knows for entry in agent_entries())


def test_register_agent__makes_names_and_policies_known():
    seen = []

    def factory(argument, settings):
        seen.append((argument, settings.policy, settings.harm_count))
        return make_agent("coast")

    register_agent("mine", factory, takes_policy=True)
    register_agent("mine", factory, takes_policy=True)  # the same again changes nothing
    for spec in ("mine", "mine:x", "mine@my-run", "mine:x@C:/runs/my run@2"):
        make_agent(spec, harm_count="total")
    assert [each[:2] for each in seen] == [(None, None), ("x", None), (None, "my-run"), ("x", "C:/runs/my run@2")]
    assert {each[2] for each in seen} == {"total"} and "mine" in agent_names()
    with pytest.raises(AlreadyExists, match="agent 'mine' is registered already"):
        register_agent("mine", lambda argument, settings: make_agent("coast"))


def test_drive__terms_of_an_episode_that_has_ended_stay_as_they_are_while_others_run():
    worlds, brake = SCENARIO.sample(20, 7).worlds, make_agent("full_brake")

    def risk(some: Worlds) -> list[list[float]]:
        engine = episode_engine(some, brake, SCENARIO, 1, {"harm": 0.0, "risk": 1.0})
        return Episodes.of(engine, some, summed=("risk",)).terms["risk"].tolist()

    assert risk(worlds) == [risk(worlds.take([k]))[0] for k in range(20)]
