"""What agents say they know, and whether that is all they use."""

from __future__ import annotations

import itertools
import re
from dataclasses import replace

import numpy as np
import pytest

from ethbrake_marl.agents import make_agent
from ethbrake_marl.agents.believed import Told
from ethbrake_marl.agents.registry import Agent, Knowledge, Source, Team, agent_entries, find_entry, parse_spec
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.physics import Messages
from ethbrake_marl.scenario import Scenario, load_scenario
from ethbrake_marl.scenario.v2x import PRESETS
from ethbrake_marl.shield.uncertainty import parse_uncertainty
from tests.agents.honesty import changed_decisions
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
    "best_harm:20": (MODEL,),
    "e_v2x_bm:believed": (BELIEFS,),
    "e_v2x_bm:pairwise:believed": (BELIEFS,),
    "planner:20:believed": (BELIEFS,),
    "coast+step:believed": (SENSORS, BELIEFS),
    "coast+robust:believed": (SENSORS, BELIEFS),
    "coast+robust:interior:believed": (SENSORS, BELIEFS),
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
    "ppo@shipped/ppo+refined:profile": (MESSAGES, MODEL),
    "ppo@shipped/ppo+refined:50": (MESSAGES, MODEL),
    "ppo@shipped/ppo+robust": (MESSAGES, MODEL),
    "ppo@shipped/ppo+robust:interior": (MESSAGES, MODEL),
}
APART = {"counterfactual@PATH", "team@RUN"}  # they need a run, and have tests of their own
USUAL = {"planner": "planner:20", "planner:believed": "planner:20:believed", "best_harm": "best_harm:20"}  # budgets
WORDS = {"A": "3", "CANDIDATES": "20", "20ms": "20", "200us": "50", "PATH": "shipped", "RUN": "shipped"}
HONEST, SEEING = (  # what bounds a box takes minutes to compile
    [
        pytest.param(spec, marks=pytest.mark.slow if "interior" in spec else ())
        for spec, knows in STATED.items()
        if Knowledge(knows).sees_through == seeing
    ]
    for seeing in (False, True)
)
CHANNELS = [
    *PRESETS,
    *({"preset": preset, "persistence": "periodic"} for preset in PRESETS if preset not in ("paper", "sensors-only")),
    {"preset": "paper", "hears": "front"},
    {"preset": "nominal", "persistence": "periodic", "senses": "front", "sensing_s": [1.5, 1.5]},
]
HIDING = [channel for channel in CHANNELS if channel not in ("paper", "clear", "nominal")]


class Silent:
    """An agent of the user's own that says nothing."""

    name = "silent"

    def act(self, worlds, vehicle):
        return np.zeros(worlds.n)


class Leaking(Silent):
    """Says it knows messages, and looks at the speed of the vehicle behind."""

    name, knows = "leaking", "messages"

    def act(self, worlds, vehicle):
        return -0.1 * worlds.speeds_mps[:, vehicle + 1]


def agent_of(spec: str, scenario: Scenario = PAPER) -> Agent:
    uncertainty = parse_uncertainty("gaps_m=0.5") if parse_spec(spec).shield in ("robust", "robust:interior") else None
    return make_lineup([spec], scenario, uncertainty=uncertainty)[spec]


def written_forms():
    """Every way in which an agent of the registry, or what goes around one, can be written."""
    for form in (entry.form for entry in agent_entries() if isinstance(entry.make, str)):  # not those of other tests
        parts = re.split(r"\[([^]]*)\]", form)  # what must be there, and between what may be, as A|B
        choices = [(part,) if k % 2 == 0 else ("", *part.split("|")) for k, part in enumerate(parts)]
        yield form, {"".join(each) for each in itertools.product(*choices)}


def with_words(form):
    """A form with numbers and paths in it, as the table above has them."""
    return USUAL.get(form) or re.sub(r"[A-Za-z0-9]+", lambda found: WORDS.get(found[0], found[0]), form)


def stands_in_table(form):
    """Whether the table has that agent, or somebody with that around it."""
    wanted = with_words(form)
    if form.startswith("+"):
        return any(f"+{around}" == wanted for spec in STATED for around in parse_spec(spec).around)
    own = {str(replace(parse_spec(spec), around=())).replace("shipped/ppo", "shipped") for spec in STATED}
    return wanted in {each.replace("shipped/sac", "shipped") for each in own}


def test_knowledge__every_agent_of_the_registry_stands_in_the_table():
    missing = [each for form, variants in written_forms() for each in sorted(variants) if form not in APART
               and not stands_in_table(each)]  # fmt: skip
    assert not missing, "registered, and not in STATED, so nobody tests whether they are honest"


@pytest.mark.parametrize("form", ["+step:believed", "e_v2x_bm[:pairwise][:believed]"])
def test_knowledge__an_agent_that_nobody_wrote_down_is_found(form, monkeypatch):
    for spec in [spec for spec in STATED if spec.endswith(":believed")]:
        monkeypatch.delitem(STATED, spec)
    with pytest.raises(AssertionError, match="nobody tests whether they are honest"):
        test_knowledge__every_agent_of_the_registry_stands_in_the_table()


@pytest.mark.parametrize("spec", STATED)
def test_knowledge__every_agent_states_it(spec):
    knows = STATED[spec]
    assert Knowledge.of(agent_of(spec)) == knows
    if "+" not in spec and spec != "e_v2x_bm:pairwise" and not spec.endswith(":believed"):
        assert Knowledge.of(find_entry(parse_spec(spec))) == knows, "`ethbrake agent list` says something else"


def test_knowledge__a_wrapper_adds_the_model_to_what_its_policy_knows():
    for shield in ("episode", "step"):
        assert Knowledge.of(agent_of(f"ppo@shipped/ppo+{shield}")) == (MESSAGES, MODEL)
    assert Knowledge.of(Silent(), also=MODEL) == (MODEL, Source.UNSTATED)


def test_knowledge__a_team_knows_what_its_drivers_know():
    assert Knowledge.of(Team({1: agent_of("ppo@shipped/ppo"), 2: agent_of("full_brake")}, "both")) == (
        SENSORS,
        MESSAGES,
    )
    assert Knowledge.of(Team({}, "scripts")).text == "–"


def test_knowledge__an_agent_of_the_users_own_is_not_stated():
    assert Knowledge.of(Silent()).text == "not stated"
    assert not Knowledge.of(Silent()).sees_through
    assert Knowledge.of(Leaking()) == (MESSAGES,)


@pytest.mark.parametrize("knows", ["everything", 3, ("messages", "gossip"), [["messages"]]])
def test_knowledge__another_word_is_refused(knows):
    agent = Silent()
    agent.knows = knows
    with pytest.raises(InvalidInput, match=r"agent 'silent': knows = .*'messages', 'believed model', 'true state'"):
        Knowledge.of(agent)


@pytest.mark.parametrize(
    ("spec", "channel"),
    [
        # What goes around an agent, or believes, sees what it is told; the fast ones are three kinds of telling.
        pytest.param(*spec.values, channel, marks=[*spec.marks, *slow])
        for spec in HONEST
        for k, channel in enumerate(HIDING)
        for slow in [(pytest.mark.slow,) if k % 3 and (":" in spec.values[0] or "+" in spec.values[0]) else ()]
    ],
    ids=str,
)
def test_own_sensors_and_messages__what_was_not_received_changes_no_action(spec, channel):
    n = 2 if "interior" in spec else 4 if "robust" in spec else 10
    scenario = BLOCKED.replace(v2x=channel)
    assert changed_decisions(agent_of(spec, scenario), scenario, n=n) == 0


@pytest.mark.parametrize("channel", ["blocked", {"preset": "blocked", "persistence": "periodic"}], ids=str)
@pytest.mark.parametrize(
    "spec", ["ppo@shipped/ppo-paper-random-obstacle", "e_v2x_bm:believed", "coast+robust:believed"]
)
def test_own_sensors_and_messages__nor_where_an_obstacle_is_that_was_not_received(spec, channel):
    scenario = load_scenario("cooperation-4-all").with_learners(["vehicle_2"]).replace(v2x=channel)
    assert changed_decisions(agent_of(spec, scenario), scenario, n=5 if "robust" in spec else 20) == 0
    assert changed_decisions(agent_of("gentlest_front", scenario), scenario, n=20) > 0


@pytest.mark.parametrize("channel", HIDING, ids=str)
def test_channels__hide_something_to_be_altered(channel):
    worlds = BLOCKED.replace(v2x=channel).sample(60, 11).worlds
    assert (worlds.vehicles.hide_from(1) | Messages.of(worlds).periodic).sum() > 3


@pytest.mark.parametrize("channel", ["blocked", {"preset": "blocked", "persistence": "periodic"}], ids=str)
def test_messages__contact_features_tell_nothing_that_was_not_received(channel, tmp_path):
    scenario = BLOCKED.replace(v2x=channel)
    contact_policy(scenario.model_dump(mode="json")).save(tmp_path / "policy")
    agent = agent_of(f"counterfactual@{tmp_path}", scenario)
    assert Knowledge.of(agent) == (MESSAGES,)
    assert changed_decisions(agent, scenario) == 0


def test_own_sensors_and_messages__a_planted_leak_is_found():
    assert changed_decisions(Leaking(), BLOCKED) > 50


class Guessing(Leaking):
    """Decides on what others have heard, or on what it will never hear."""

    def __init__(self, reads):
        self.reads = reads

    def act(self, worlds, vehicle):
        known = worlds.vehicles.known_from_s
        seen = known[:, 2, 0] <= worlds.time_s if self.reads == "others" else np.isinf(known[:, vehicle]).any(axis=1)
        return np.where(seen, -1.0, -0.5) * worlds.vehicles.braking_capacity_mps2[:, vehicle]


@pytest.mark.parametrize(("reads", "vehicle"), [("others", 1), ("never", 2)])
def test_changed_decisions__finds_who_reads_what_others_heard_or_what_will_never_come(reads, vehicle):
    assert changed_decisions(Guessing(reads), BLOCKED, vehicle=vehicle) > 10


def test_changed_decisions__lets_other_learners_brake_fully():
    pair = load_scenario("cooperation-3-pair").replace(v2x="blocked")
    assert [changed_decisions(make_agent("full_brake"), pair, vehicle=i) for i in (1, 2)] == [0, 0]


@pytest.mark.parametrize("spec", ["e_v2x_bm:believed", "coast+step:believed", "ppo@shipped/ppo+episode:believed"])
@pytest.mark.parametrize("leak", ["known", "speed_mps"])
def test_believed_model__a_planted_leak_is_found(spec, leak, monkeypatch):
    honest = Told.to

    def leaking(worlds, vehicle):
        told = honest(worlds, vehicle)
        if leak == "known":
            return told._replace(known=np.ones_like(told.known))
        return told._replace(speed_mps=worlds.speeds_mps.copy())

    scenario = BLOCKED.replace(v2x={"preset": "blocked", "persistence": "periodic"})
    monkeypatch.setattr(Told, "to", leaking)
    assert changed_decisions(agent_of(spec, scenario), scenario, n=100) > 0


@pytest.mark.parametrize("spec", SEEING)
def test_true_state_and_model__is_not_said_without_need(spec):
    if spec in ("copy_leader", "gentlest_front"):  # look ahead only: Vehicle 3 may hear Vehicle 1 and not Vehicle 2
        scenario, vehicle = BLOCKED.with_learners(["vehicle_3"]), 2
    else:
        scenario, vehicle = BLOCKED.replace(v2x={"preset": "paper", "hears": "front"}), 1
    n = 40 if vehicle == 2 else 6
    assert changed_decisions(agent_of(spec, scenario), scenario, vehicle=vehicle, decisions=1, n=n) > 0


def test_hidden__only_where_news_or_a_reaction_is_late():
    def hidden(v2x):
        return BLOCKED.replace(v2x=v2x).sample(200, 7).worlds.vehicles.hide_from(1)

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
    assert late.hide_from(1).tolist() == [False, True]
    assert late.hide_from(2).tolist() == [False, False]  # its own reaction is not hidden from it
