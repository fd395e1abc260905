"""What agents say they know, and whether that is all they use."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest

from ethbrake_marl.agents import believed
from ethbrake_marl.agents.believed import told_to
from ethbrake_marl.agents.knowledge import Source, combine, knowledge_of, knowledge_text, sees_through
from ethbrake_marl.agents.protocol import Agent
from ethbrake_marl.agents.registry import agent_names, find_entry
from ethbrake_marl.agents.rollout import script_agents, set_others
from ethbrake_marl.agents.spelling import parse_spec
from ethbrake_marl.agents.team import Team
from ethbrake_marl.engine.engine import Engine
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.physics import Worlds
from ethbrake_marl.physics.estimates import age_s, is_periodic, links_of
from ethbrake_marl.physics.messages import KEY, LINK, TAKEN, TOLD_S, link_at, place_at, ring_at
from ethbrake_marl.policies.policy import save_policy
from ethbrake_marl.scenario import Scenario, load_scenario
from ethbrake_marl.scenario.v2x import hidden_from
from tests.test_contact_features import contact_policy

PAPER = load_scenario("paper-random")
BLOCKED = load_scenario("cooperation-2-blocked")

SENSORS, MESSAGES, BELIEFS, STATE, MODEL = (
    Source.SENSORS, Source.MESSAGES, Source.BELIEFS, Source.STATE, Source.MODEL,
)  # fmt: skip

STATED = {  # every agent there is: all of the registry, and what ``make_lineup`` makes of policies
    "full_brake": (SENSORS,),
    "coast": (SENSORS,),
    "constant:3": (SENSORS,),
    "copy_leader": (STATE,),
    "gentlest_front": (STATE,),
    "e_v2x_bm:pairwise": (STATE,),
    "e_v2x_bm": (MODEL,),
    "planner:20": (MODEL,),
    "best_harm:100": (MODEL,),
    "e_v2x_bm:believed": (BELIEFS,),
    "e_v2x_bm:pairwise:believed": (BELIEFS,),
    "planner:20:believed": (BELIEFS,),
    "coast+step:believed": (SENSORS, BELIEFS),
    "coast+robust:believed": (SENSORS, BELIEFS),
    "ppo@shipped/ppo+step:believed": (MESSAGES, BELIEFS),
    "ppo@shipped/ppo+episode:believed": (MESSAGES, BELIEFS),
    "ppo@shipped/ppo+episode:pairwise:believed": (MESSAGES, BELIEFS),
    "ppo@shipped/ppo": (MESSAGES,),
    "sac@shipped/sac": (MESSAGES,),
    "policy@shipped": (MESSAGES,),
    "universal@shipped": (MESSAGES,),
    "ppo@shipped/ppo+refined": (MESSAGES, MODEL),
    "ppo@shipped/ppo+episode": (MESSAGES, MODEL),
    "ppo@shipped/ppo+episode:pairwise": (MESSAGES, MODEL),
    "ppo@shipped/ppo+refined+episode": (MESSAGES, MODEL),
    "ppo@shipped/ppo+step": (MESSAGES, MODEL),
    "ppo@shipped/ppo+refined+step": (MESSAGES, MODEL),
}
HONEST = [spec for spec, knows in STATED.items() if not sees_through(knows)]
CHANNELS = [
    "blocked",
    "sensors-only",
    {"preset": "paper", "hears": "front"},
    {"preset": "blocked", "persistence": "periodic"},
    {"preset": "nominal", "persistence": "periodic", "senses": "front", "sensing_s": [1.5, 1.5]},
]


class Silent:
    """An agent of the user's own that says nothing."""

    name = "silent"

    def begin(self, worlds, vehicle, rows):
        pass

    def act(self, worlds, vehicle):
        return np.zeros(worlds.n)


class Leaking(Silent):
    """Says it knows messages, and looks at the speed of the vehicle behind."""

    name, knows = "leaking", "messages"

    def act(self, worlds, vehicle):
        return -0.1 * worlds.speeds_mps[:, vehicle + 1]


def agent_of(spec: str, scenario: Scenario = PAPER) -> Agent:
    return make_lineup([spec], scenario)[spec]


def test_knowledge__every_agent_of_the_registry_states_it():
    kinds = {spec.partition("@")[0].partition(":")[0] for spec in STATED} | {"team", "counterfactual"}
    assert set(agent_names()) <= kinds, "an agent is registered that this test does not know"
    for spec, knows in STATED.items():
        assert knowledge_of(agent_of(spec)) == knows, spec
        if "+" not in spec and spec != "e_v2x_bm:pairwise" and not spec.endswith(":believed"):
            assert find_entry(parse_spec(spec)).knows == knows, f"{spec}: `ethbrake agents` says something else"


def test_knowledge__a_wrapper_adds_the_model_to_what_its_policy_knows():
    for shield in ("episode", "step"):
        assert knowledge_of(agent_of(f"ppo@shipped/ppo+{shield}")) == (MESSAGES, MODEL)
    assert combine(Silent(), also=MODEL) == (MODEL, Source.UNSTATED)


def test_knowledge__a_team_knows_what_its_drivers_know():
    assert knowledge_of(Team({1: agent_of("ppo@shipped/ppo"), 2: agent_of("full_brake")}, "both")) == (
        SENSORS,
        MESSAGES,
    )
    assert knowledge_text(knowledge_of(Team({}, "scripts"))) == "–"


def test_knowledge__an_agent_of_the_users_own_is_not_stated():
    assert knowledge_text(knowledge_of(Silent())) == "not stated"
    assert not sees_through(knowledge_of(Silent()))
    assert knowledge_of(Leaking()) == (MESSAGES,)


@pytest.mark.parametrize("knows", ["everything", 3, ("messages", "gossip"), [["messages"]]])
def test_knowledge__another_word_is_refused(knows):
    agent = Silent()
    agent.knows = knows
    with pytest.raises(InvalidInput, match=r"agent 'silent': knows = .*'messages', 'believed model', 'true state'"):
        knowledge_of(agent)


def altered(worlds: Worlds, observer: int, rng: np.random.Generator) -> Worlds:
    """The same worlds with everything changed that has not reached ``observer`` by now, the future included."""
    vehicles, now = worlds.vehicles, worlds.time_s[:, np.newaxis]
    n, N = worlds.speeds_mps.shape
    unknown = vehicles.known_from_s[:, observer] > now
    unknown[:, observer] = False  # of itself it knows
    stale = unknown.copy()  # whose present it does not know
    if is_periodic(worlds).all():
        stale |= age_s(worlds)[:, observer] > 0.0
    beside = np.zeros((n, N - 1), np.bool_)
    for pair in range(N - 1):
        far = pair if pair < observer else pair + 1
        beside[:, pair] = stale[:, far]

    def other(values, low, high, where):
        return np.where(where, rng.uniform(low, high, values.shape), values)

    later = np.where(vehicles.latency_s > now, vehicles.latency_s + rng.uniform(0.01, 1.0, (n, N)), vehicles.latency_s)
    latency = np.where(unknown, rng.uniform(0.0, 2.0, (n, N)), vehicles.latency_s)
    latency[:, observer] = later[:, observer]
    news = vehicles.known_from_s
    news = np.where(news > now[:, :, np.newaxis], news + rng.uniform(0.01, 1.0, news.shape), news)
    changed = replace(
        vehicles,
        braking_capacity_mps2=other(vehicles.braking_capacity_mps2, 3.0, 9.0, unknown),
        driving_capacity_mps2=other(vehicles.driving_capacity_mps2, 0.0, 9.0, unknown),
        mass_t=other(vehicles.mass_t, 1.0, 40.0, unknown),
        speed_limit_mps=other(vehicles.speed_limit_mps, 30.0, 60.0, unknown),
        latency_s=latency,
        own_latency_s=other(vehicles.own_latency_s, 0.0, 2.0, unknown),
        known_from_s=news,
    )
    of_pair = beside.copy()
    of_pair[:, [pair for pair in (observer - 1, observer) if 0 <= pair < N - 1]] &= unknown[:, [
        far for far in (observer - 1, observer + 1) if 0 <= far < N]]  # fmt: skip
    return replace(
        worlds,
        vehicles=changed,
        messages=unheard(worlds, observer, rng),
        gaps_m=other(worlds.gaps_m, 2.0, 15.0, beside),
        speeds_mps=other(worlds.speeds_mps, 5.0, 30.0, stale),
        command_mps2=other(worlds.command_mps2, -6.0, 6.0, stale),
        pair_hit=worlds.pair_hit ^ (of_pair & (now > 0.0)),  # at the alert nobody has hit anything
    )


def unheard(worlds: Worlds, observer: int, rng: np.random.Generator) -> np.ndarray:
    """The columns of messages with all changed that ``observer`` has not heard: chance, what is on its way, others'."""
    columns, N = worlds.messages.copy(), worlds.N
    if not columns.shape[1]:
        return columns
    kept = links_of(worlds)[:, observer].copy()
    own = columns[:, place_at(N) + observer].copy()
    columns[:, [KEY, TAKEN]] += 5.0
    columns[:, place_at(N) :] += rng.uniform(0.5, 3.0, columns[:, place_at(N) :].shape)
    links = columns[:, link_at(0, 0, N) : ring_at(N)].reshape(-1, N, N, LINK)
    heard = (worlds.vehicles.known_from_s[:, observer] <= worlds.time_s[:, np.newaxis])[..., np.newaxis]
    told = np.arange(LINK) >= TOLD_S
    links[:, observer] = np.where(heard & told, kept, links[:, observer])
    columns[:, place_at(N) + observer] = own
    return columns


def changed_actions(agent: Agent, scenario: Scenario, vehicle: int = 1, *, steps: int = 8, n: int = 40) -> int:
    """Decisions that differ when what has not been received is altered, at the alert and at each of the first steps."""
    rng = np.random.default_rng(3)
    alert = scenario.sample(n, 11).worlds
    scripts = script_agents(scenario, except_for=vehicle)
    knowing, wondering = copy.deepcopy(agent), copy.deepcopy(agent)
    engine = Engine(scenario, n, learners=[vehicle], scripts=scripts, worlds=alert)
    for driver, at_alert in ((knowing, alert), (wondering, altered(alert, vehicle, rng))):
        set_others(driver, vehicle, scripts)
        driver.begin(at_alert, vehicle, np.arange(n))
    differing = 0
    for _ in range(steps):
        now = engine.worlds
        command = knowing.act(now, vehicle)
        differing += int((wondering.act(altered(now, vehicle, rng), vehicle) != command).sum())
        engine.step({vehicle: np.clip(command / 7.0, -1.0, 1.0)})
    return differing


@pytest.mark.parametrize("channel", CHANNELS, ids=str)
@pytest.mark.parametrize("spec", HONEST)
def test_own_sensors_and_messages__what_was_not_received_changes_no_action(spec, channel):
    scenario = BLOCKED.replace(v2x=channel)
    worlds = scenario.sample(60, 11).worlds
    assert (hidden_from(worlds.vehicles, 1) | is_periodic(worlds)).sum() > 20
    assert changed_actions(agent_of(spec, scenario), scenario) == 0


@pytest.mark.parametrize("channel", CHANNELS, ids=str)
def test_messages__contact_features_tell_nothing_that_was_not_received(channel, tmp_path):
    scenario = BLOCKED.replace(v2x=channel)
    save_policy(contact_policy(scenario.model_dump(mode="json")), tmp_path / "policy")
    agent = agent_of(f"counterfactual@{tmp_path}", scenario)
    assert knowledge_of(agent) == (MESSAGES,)
    assert changed_actions(agent, scenario) == 0


def test_own_sensors_and_messages__a_planted_leak_is_found():
    assert changed_actions(Leaking(), BLOCKED) > 50


@pytest.mark.parametrize("spec", ["e_v2x_bm:believed", "coast+step:believed", "ppo@shipped/ppo+episode:believed"])
@pytest.mark.parametrize("leak", ["known", "speed_mps"])
def test_believed_model__a_planted_leak_is_found(spec, leak, monkeypatch):
    def leaking(worlds, vehicle):
        told = told_to(worlds, vehicle)
        if leak == "known":
            return told._replace(known=np.ones_like(told.known))
        return told._replace(speed_mps=worlds.speeds_mps.copy())

    scenario = BLOCKED.replace(v2x=CHANNELS[3])
    monkeypatch.setattr(believed, "told_to", leaking)
    assert changed_actions(agent_of(spec, scenario), scenario) > 0


@pytest.mark.parametrize("spec", [spec for spec in STATED if spec not in HONEST])
def test_true_state_and_model__is_not_said_without_need(spec):
    if spec in ("copy_leader", "gentlest_front"):  # look ahead only: Vehicle 3 may hear Vehicle 1 and not Vehicle 2
        scenario, vehicle = BLOCKED.with_learners(["vehicle_3"]), 2
    else:
        scenario, vehicle = BLOCKED.replace(v2x={"preset": "paper", "hears": "front"}), 1
    assert changed_actions(agent_of(spec, scenario), scenario, vehicle, steps=1, n=40 if vehicle == 2 else 6) > 0


def test_hidden__only_where_news_or_a_reaction_is_late():
    def hidden(v2x):
        return hidden_from(BLOCKED.replace(v2x=v2x).sample(200, 7).worlds.vehicles, 1)

    assert not hidden("paper").any()
    assert not hidden({"preset": "paper", "link_latency_s": 0.1, "senses": "both"}).any()  # clear: all in time
    assert hidden({"preset": "paper", "link_latency_s": 0.6, "senses": "both", "hears": "front"}).all()
    assert hidden({"preset": "paper", "hears": "front"}).all()
    assert hidden("sensors-only").all()
    assert 0.3 < hidden("blocked").mean() < 0.7
    assert hidden("clear").mean() < 0.1  # a burst of losses now and then


def test_hidden__a_late_reaction_of_another_vehicle_counts():
    vehicles = BLOCKED.replace(v2x={"preset": "paper", "link_latency_s": 0.1, "senses": "both"}).sample(2, 7)
    vehicles = vehicles.worlds.vehicles
    latency = vehicles.latency_s.copy()
    latency[1, 2] += 0.5
    late = replace(vehicles, latency_s=latency)
    assert hidden_from(late, 1).tolist() == [False, True]
    assert hidden_from(late, 2).tolist() == [False, False]  # its own reaction is not hidden from it
