"""What agents say they know, and whether that is all they use; those of extensions: tests/extensions."""

import itertools
import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.agents.driving import script_agents
from ethbrake_marl.first_edition.agents.making import find_entry
from ethbrake_marl.first_edition.agents.protocol import Knowledge, Source
from ethbrake_marl.first_edition.agents.registry import agent_entries
from ethbrake_marl.first_edition.agents.spec import parse_spec
from ethbrake_marl.first_edition.engine.memory import Memory, ask_script, begin_script
from ethbrake_marl.first_edition.engine.scripts import Script
from ethbrake_marl.first_edition.evaluation.lineup import make_lineup
from ethbrake_marl.first_edition.game.actions import action_to_command, command_to_action
from ethbrake_marl.first_edition.physics.columns import Packed
from ethbrake_marl.first_edition.physics.messages import Messages
from ethbrake_marl.first_edition.physics.state import Floats
from ethbrake_marl.first_edition.scenario.channel import PRESETS
from ethbrake_marl.first_edition.shields.comparison import seen_columns
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver
from ethbrake_marl.first_edition.shields.rollouts import Proposer, proposed_action
from tests.first_edition.rest.fixture_asked import Acts
from tests.first_edition.rest.fixture_knowledge import alter_unreceived
from tests.first_edition.rest.fixture_policies import make_policy


def changed_decisions(
    agent: eb.Agent, scenario: eb.Scenario, *, vehicle: int = 1, n: int = 100, decisions: int = 8, seed: int = 11
) -> int:
    """How many decisions change when all is altered that has not reached the vehicle by then: 0 for an honest agent.

    The agent drives twice the first ``n`` worlds of a list, or are asked what it would do in them: once it sees
    the worlds as they are, once with random numbers for what was not received, at the alert and anew at each
    of the first ``decisions``. Take a scenario with a channel that hides something, or nothing is altered.

    Args:
        agent: any; it is left as it is.
        scenario: whose worlds.
        vehicle: the driven one, from 0, beside which other learners brake fully.
        n: number of worlds; more find rarer leaks.
        decisions: in each world.
        seed: of the list, and of the random numbers.

    """
    scenario = scenario.with_learners([vehicle])
    rng, alert = np.random.default_rng(seed), scenario.sample(n, seed).worlds
    scripts = script_agents(scenario, except_for=vehicle)
    if isinstance(agent, ShieldedDriver):
        agent = Hosted(agent)
    engine = eb.Engine(scenario, n, learners=[vehicle], scripts=scripts, worlds=alert)
    seen = (alert, alter_unreceived(alert, vehicle, rng))
    knowing, wondering = (begin_script(agent, at_alert, vehicle, scripts) for at_alert in seen)
    changed = 0
    for _ in range(decisions):
        now = engine.worlds
        command, knowing = ask_script(agent, now, knowing, vehicle)
        other, wondering = ask_script(agent, alter_unreceived(now, vehicle, rng), wondering, vehicle)
        changed += int((other != command).sum())
        engine.step({vehicle: command_to_action(command, now.vehicles, vehicle)})
    return changed


class Hosted:
    """Who is behind a shield, asked in worlds of the caller's as an agent is."""

    name = "hosted"
    __module__ = "ethbrake_marl.hosted"  # its memory holds a shield, which that of no agent from outside may

    def __init__(self, driver: ShieldedDriver) -> None:
        self.driver, self.policy = driver, driver.policy

    def begin(self, alert: eb.Worlds, vehicle: int, scripts: Mapping[int, Script]) -> Memory:
        options, scenario = self.driver.options, self.driver.scenario
        shield = options.shield(scenario, vehicle, scripts)
        if getattr(options, "estimated", False):
            shield.begin(alert, np.arange(alert.n))
        else:
            shield.begin(alert, np.arange(alert.n), {vehicle: self.policy})
        return np.array([shield] * alert.n), begin_script(self.policy, alert, vehicle, scripts)

    def act(self, worlds: eb.Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        (shield, *_), policy = memory
        proposed, policy = proposed_action(self.policy, worlds, policy, vehicle)
        proposer = Proposer({vehicle: self.policy}, {vehicle: policy}, worlds)
        if getattr(self.driver.options, "estimated", False):
            applied = shield.decide(worlds, proposed, proposer)
        else:
            applied = shield.decide(
                proposed, seen=seen_columns(Packed.of(worlds))[:, : 3 * worlds.N - 2], proposer=proposer
            ).applied
        return action_to_command(applied, worlds.vehicles, vehicle), (memory[0], policy)


PAPER = eb.load_scenario("paper-random")
BLOCKED = eb.load_scenario("cooperation-2-blocked")
SENSORS, MESSAGES, ESTIMATES, STATE, MODEL = (
    Source.SENSORS, Source.MESSAGES, Source.ESTIMATES, Source.STATE, Source.MODEL,
)  # fmt: skip
STATED = {  # every agent of the core: all of the registry, and what ``make_lineup`` makes of policies
    "full_brake": (SENSORS,),
    "coast": (SENSORS,),
    "constant:3": (SENSORS,),
    "e_v2x_bm:pairwise": (STATE,),
    "e_v2x_bm": (MODEL,),
    "ppo": (MESSAGES,),
    "sac": (MESSAGES,),
    "universal": (MESSAGES,),
    "ppo-obstacle": (MESSAGES,),
    "rollout-obstacle": (MESSAGES,),
    "vine-preference": (MESSAGES,),
    "vine-front": (MESSAGES,),
    "vine-pair": (MESSAGES,),
    "vine-all": (MESSAGES,),
    "ppo+episode": (MESSAGES, MODEL),
    "ppo+episode:pairwise": (MESSAGES, MODEL),
    "ppo+step": (MESSAGES, MODEL),
}
APART = {"policy@PATH", "team@RUN"}  # they need a run, and have tests of their own
USUAL: dict[str, str] = {}  # with an argument that the form leaves open, for instance a budget
WORDS = {"A": "3", "CANDIDATES": "20"}


def in_two(stated):
    """Those that do not see through a channel, and those that do."""
    return (
        [spec for spec, knows in stated.items() if Knowledge(knows).sees_through == seeing] for seeing in (False, True)
    )


HONEST, SEEING = in_two(STATED)
CHANNELS = [
    *PRESETS,
    *({"preset": preset, "persistence": "periodic"} for preset in PRESETS if preset not in ("paper", "sensors-only")),
    {"preset": "paper", "hears": "front"},
    {"preset": "nominal", "persistence": "periodic", "senses": "front", "sensing_s": [1.5, 1.5]},
]
HIDING = [channel for channel in CHANNELS if channel not in ("paper", "clear", "nominal")]


class Leaking:
    """Says it knows messages, and decides on who is behind it, what others have heard, or what it will never hear."""

    name, knows = "leaking", "messages"

    def __init__(self, reads="behind"):
        self.reads = reads

    def act(self, worlds, vehicle):
        known = worlds.vehicles.known_from_s
        seen = known[:, 2, 0] <= worlds.time_s if self.reads == "others" else np.isinf(known[:, vehicle]).any(axis=1)
        if self.reads == "behind":
            seen = worlds.speeds_mps[:, vehicle + 1] > 15.0
        return np.where(seen, -1.0, -0.5) * worlds.vehicles.braking_capacity_mps2[:, vehicle]


def agent_of(spec: str, scenario: eb.Scenario = PAPER) -> eb.Agent:
    return make_lineup([spec], scenario)[spec]


def written_forms():
    """Every way in which an agent of the registry, or what goes around one, can be written."""
    for form in (entry.form for entry in agent_entries() if entry.is_ours):  # not those of other tests
        parts = re.split(r"\[([^]]*)\]", form)  # what must be there, and between what may be, as A|B
        choices = [(part,) if k % 2 == 0 else ("", *part.split("|")) for k, part in enumerate(parts)]
        yield form, {"".join(each) for each in itertools.product(*choices)}


def with_words(form, usual):
    """A form with numbers and paths in it, as the table above has them."""
    return usual.get(form) or re.sub(r"[A-Za-z0-9]+", lambda found: WORDS.get(found[0], found[0]), form)


def stands_in_table(form, stated, usual):
    """Whether the table has that agent, or somebody with that around it."""
    wanted = with_words(form, usual)
    if form.startswith("+"):
        return any(f"+{around}" == wanted for spec in stated for around in parse_spec(spec).around)
    return wanted.removesuffix("@PATH") in {str(replace(parse_spec(spec), around=())) for spec in stated}


def missing_in(stated, usual, apart):
    """Forms of registered agents that nobody tests for honesty."""
    return [
        each
        for form, variants in written_forms()
        for each in sorted(variants)
        if form not in apart and not stands_in_table(each, stated, usual)
    ]


@pytest.mark.usefixtures("core_alone")
def test_knowledge__every_agent_of_the_registry_stands_in_the_table():
    missing = missing_in(STATED, USUAL, APART)
    assert not missing, "registered, and not in STATED, so nobody tests whether they are honest"


def check_stated(spec, agent, knows):
    assert Knowledge.of(agent) == knows
    if "+" not in spec and spec != "e_v2x_bm:pairwise" and not spec.endswith(":estimated"):
        assert Knowledge.of(find_entry(parse_spec(spec))) == knows, "`ethbrake agent list` says something else"


@pytest.mark.parametrize(("spec", "knows"), STATED.items())
def test_knowledge__every_agent_states_it(spec, knows):
    check_stated(spec, agent_of(spec), knows)


def with_channels(honest):
    """Each of these agents in each channel that hides something.

    What goes around an agent, or estimates, sees what it is told; the fast ones are three kinds of telling.
    """
    return [
        pytest.param(spec, channel, marks=pytest.mark.slow if k % 3 and (":" in spec or "+" in spec) else ())
        for spec in honest
        for k, channel in enumerate(HIDING)
    ]


@pytest.mark.parametrize(("spec", "channel"), with_channels(HONEST), ids=str)
def test_own_sensors_and_messages__what_was_not_received_changes_no_action(spec, channel):
    scenario = BLOCKED.replace(v2x=channel)
    assert changed_decisions(agent_of(spec, scenario), scenario, n=10) == 0


@pytest.mark.parametrize("channel", ["blocked", {"preset": "blocked", "persistence": "periodic"}], ids=str)
def test_own_sensors_and_messages__nor_where_an_obstacle_is_that_was_not_received(channel):
    scenario = eb.load_scenario("cooperation-4-all").with_learners(["vehicle_2"]).replace(v2x=channel)
    assert changed_decisions(agent_of("ppo-obstacle", scenario), scenario, n=20) == 0
    assert changed_decisions(agent_of("e_v2x_bm:pairwise", scenario), scenario, n=20) > 0


@pytest.mark.parametrize("channel", ["blocked", {"preset": "blocked", "persistence": "periodic"}], ids=str)
def test_messages__contact_features_tell_nothing_that_was_not_received(channel, tmp_path):
    scenario = BLOCKED.replace(v2x=channel)
    make_policy(eb.choose_observation(["own", "contact"]), scenario.model_dump(mode="json")).save(tmp_path / "policy")
    agent = agent_of(f"ppo@{tmp_path}", scenario)
    assert Knowledge.of(agent) == (MESSAGES,) and changed_decisions(agent, scenario) == 0


@pytest.mark.parametrize(("reads", "vehicle"), [("behind", 1), ("others", 1), ("never", 2)])
def test_own_sensors_and_messages__a_planted_leak_is_found(reads, vehicle):
    assert changed_decisions(Leaking(reads), BLOCKED, vehicle=vehicle) > 10


@pytest.mark.parametrize("spec", SEEING)
def test_true_state_and_model__is_not_said_without_need(spec):
    scenario = BLOCKED.replace(v2x={"preset": "paper", "hears": "front"})
    assert changed_decisions(agent_of(spec, scenario), scenario, vehicle=1, decisions=1, n=4) > 0


@pytest.mark.parametrize("channel", HIDING, ids=str)
def test_channels__hide_something_to_be_altered(channel):
    worlds = BLOCKED.replace(v2x=channel).sample(60, 11).worlds
    assert (worlds.vehicles.hide_from(1) | Messages.of(worlds).periodic).sum() > 3


@pytest.mark.parametrize(
    ("v2x", "least", "most"),
    [
        ("paper", 0.0, 0.0),
        ({"preset": "paper", "link_latency_s": 0.1, "senses": "both"}, 0.0, 0.0),  # clear: all in time
        ({"preset": "paper", "link_latency_s": 0.6, "senses": "both", "hears": "front"}, 1.0, 1.0),
        ({"preset": "paper", "hears": "front"}, 1.0, 1.0),
        ("sensors-only", 1.0, 1.0),
        ("blocked", 0.3, 0.7),
        ("clear", 0.0, 0.1),  # a burst of losses now and then
    ],
)
def test_hidden__only_where_news_or_a_reaction_is_late(v2x, least, most):
    vehicles = BLOCKED.replace(v2x=v2x).sample(200, 7).worlds.vehicles
    assert least <= vehicles.hide_from(1).mean() <= most
    if most == 0.0:  # then a late reaction of another vehicle is hidden, but not from itself
        latency = vehicles.latency_s.copy()
        latency[1, 2] += 0.5
        late = replace(vehicles, latency_s=latency)
        assert np.flatnonzero(late.hide_from(1)).tolist() == [1] and not late.hide_from(2).any()


def test_knowledge__of_an_agent_of_a_user_and_of_a_team() -> None:
    team = eb.Team({1: agent_of("ppo"), 2: agent_of("full_brake")}, "both")
    assert Knowledge.of(team) == (SENSORS, MESSAGES)
    assert Knowledge.of(eb.Team({}, "scripts")).text == "–"
    silent = Acts(lambda worlds, vehicle: np.zeros(worlds.n))
    assert Knowledge.of(silent).text == "not stated"
    assert not Knowledge.of(silent).sees_through
    assert Knowledge.of(silent, also=MODEL) == (MODEL, Source.UNSTATED)
    assert Knowledge.of(Leaking()) == (MESSAGES,)
