"""What agents say they know, whether that is all they use, and the worlds that they believe in."""

import itertools
import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.driving import drive, script_agents
from ethbrake_marl.agents.making import find_entry, make_agent
from ethbrake_marl.agents.protocol import Knowledge, Source
from ethbrake_marl.agents.registry import agent_entries
from ethbrake_marl.agents.spec import parse_spec
from ethbrake_marl.engine.memory import Memory, ask_script, begin_script
from ethbrake_marl.engine.scripts import Script
from ethbrake_marl.evaluation.lineup import make_lineup
from ethbrake_marl.extensions.certified.estimated import Ranges, Told
from ethbrake_marl.extensions.certified.estimating_agents import Odometer
from ethbrake_marl.extensions.certified.uncertainty import parse_uncertainty
from ethbrake_marl.game.actions import action_to_command, command_to_action
from ethbrake_marl.physics.columns import Packed
from ethbrake_marl.physics.messages import Messages
from ethbrake_marl.physics.state import Floats
from ethbrake_marl.scenario.channel import PRESETS
from ethbrake_marl.shield.comparison import seen_columns
from ethbrake_marl.shield.drivers import ShieldedDriver
from ethbrake_marl.shield.rollouts import Proposer, proposed_action
from tests.fixtures.asked import Acts
from tests.fixtures.knowledge import alter_unreceived
from tests.fixtures.policies import make_policy


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
        if getattr(options, "believed", False):
            shield.begin(alert, np.arange(alert.n))
        else:
            shield.begin(alert, np.arange(alert.n), {vehicle: self.policy})
        return np.array([shield] * alert.n), begin_script(self.policy, alert, vehicle, scripts)

    def act(self, worlds: eb.Worlds, memory: Memory, vehicle: int) -> tuple[Floats, Memory]:
        (shield, *_), policy = memory
        proposed, policy = proposed_action(self.policy, worlds, policy, vehicle)
        proposer = Proposer({vehicle: self.policy}, {vehicle: policy}, worlds)
        if getattr(self.driver.options, "believed", False):
            applied = shield.decide(worlds, proposed, proposer)
        else:
            applied = shield.decide(
                proposed, seen=seen_columns(Packed.of(worlds))[:, : 3 * worlds.N - 2], proposer=proposer
            ).applied
        return action_to_command(applied, worlds.vehicles, vehicle), (memory[0], policy)


PAPER = eb.load_scenario("paper-random")
BLOCKED = eb.load_scenario("cooperation-2-blocked")
SENSORS, MESSAGES, BELIEFS, STATE, MODEL = (
    Source.SENSORS, Source.MESSAGES, Source.BELIEFS, Source.STATE, Source.MODEL,
)  # fmt: skip
STATED = {  # every agent there is: all of the registry, and what ``make_lineup`` makes of policies
    "full_brake": (SENSORS,),
    "coast": (SENSORS,),
    "constant:3": (SENSORS,),
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
    **dict.fromkeys(("idm", "acc", "cacc", "rss", "r157_human", "r157_fsm", "aeb", "idm:T=1.5"), (MESSAGES,)),
    **dict.fromkeys(("acc:T=1.1", "cacc:T=1.0", "rss:rho=1.0", "r157_human:reaction=0.75"), (MESSAGES,)),
    **dict.fromkeys(("r157_fsm:reaction=0.75", "aeb:ttc=1.5"), (MESSAGES,)),
    "ppo@shipped/ppo": (MESSAGES,),
    "sac@shipped/sac": (MESSAGES,),
    "options@shipped/options-paper-random-obstacle-total": (MESSAGES,),
    "policy@shipped": (MESSAGES,),
    "universal@shipped": (MESSAGES,),
    "ppo@shipped/ppo+episode": (MESSAGES, MODEL),
    "ppo@shipped/ppo+episode:pairwise": (MESSAGES, MODEL),
    "ppo@shipped/ppo+search+episode": (MESSAGES, MODEL),
    "ppo@shipped/ppo+step": (MESSAGES, MODEL),
    "ppo@shipped/ppo+search+step": (MESSAGES, MODEL),
    "ppo@shipped/ppo+search": (MESSAGES, MODEL),
    "ppo@shipped/ppo+robust": (MESSAGES, MODEL),
    "ppo@shipped/ppo+robust:interior": (MESSAGES, MODEL),
}
APART = {"counterfactual@PATH", "team@RUN"}  # they need a run, and have tests of their own
USUAL = {"planner": "planner:20", "planner:believed": "planner:20:believed", "best_harm": "best_harm:20"}  # budgets
WORDS = {"A": "3", "CANDIDATES": "20", "PATH": "shipped", "RUN": "shipped"}
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
    uncertainty = parse_uncertainty("gaps_m=0.5") if parse_spec(spec).shield in ("robust", "robust:interior") else None
    return make_lineup([spec], scenario, uncertainty=uncertainty)[spec]


def written_forms():
    """Every way in which an agent of the registry, or what goes around one, can be written."""
    for form in (entry.form for entry in agent_entries() if entry.is_ours):  # not those of other tests
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
    return wanted in {re.sub("shipped/.*", "shipped", str(replace(parse_spec(spec), around=()))) for spec in STATED}


def test_knowledge__every_agent_of_the_registry_stands_in_the_table():
    missing = [each for form, variants in written_forms() for each in sorted(variants) if form not in APART
               and not stands_in_table(each)]  # fmt: skip
    assert not missing, "registered, and not in STATED, so nobody tests whether they are honest"


@pytest.mark.parametrize(("spec", "knows"), STATED.items())
def test_knowledge__every_agent_states_it(spec, knows):
    assert Knowledge.of(agent_of(spec)) == knows
    if "+" not in spec and spec != "e_v2x_bm:pairwise" and not spec.endswith(":believed"):
        assert Knowledge.of(find_entry(parse_spec(spec))) == knows, "`ethbrake agent list` says something else"


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
    scenario = eb.load_scenario("cooperation-4-all").with_learners(["vehicle_2"]).replace(v2x=channel)
    assert changed_decisions(agent_of(spec, scenario), scenario, n=3 if "robust" in spec else 20) == 0
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


@pytest.mark.parametrize("spec", ["e_v2x_bm:believed", "coast+step:believed", "ppo@shipped/ppo+episode:believed"])
@pytest.mark.parametrize("leak", ["known", "speed_mps"])
def test_believed_model__a_planted_leak_is_found(spec, leak, monkeypatch):
    honest = Told.to

    def leaking(worlds, vehicle):
        told = honest(worlds, vehicle)
        all_of_it = {"known": np.ones_like(told.known), "speed_mps": worlds.speeds_mps.copy()}
        return told._replace(**{leak: all_of_it[leak]})

    scenario = BLOCKED.replace(v2x={"preset": "blocked", "persistence": "periodic"})
    monkeypatch.setattr(Told, "to", leaking)
    assert changed_decisions(agent_of(spec, scenario), scenario, n=100) > 0


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


# ---------------------------------------------------------------- believed worlds by hand, and who drives by them

BASE = eb.load_scenario("cooperation-2-paper").replace(early_impacts="keep")
DEAF = {"preset": "paper", "hears": "front"}
PERIODIC = {"preset": "blocked", "persistence": "periodic"}


def engine_of(scenario: eb.Scenario, n: int = 40, vehicle: int = 1, seed: int = 7) -> eb.Engine:
    scripts = script_agents(scenario, except_for=vehicle)
    return eb.Engine(scenario, n, learners=[vehicle], scripts=scripts, worlds=scenario.sample(n, seed).worlds)


def believed(engine: eb.Engine, vehicle: int = 1, odometer: Odometer | None = None) -> eb.Worlds:
    worlds, scenario = engine.worlds, engine.scenario
    way = worlds.speeds_mps[:, vehicle] * worlds.time_s if odometer is None else odometer.way_m
    return Ranges.of(scenario, vehicle).believe(worlds, way)


def test_believed__is_the_world_where_everything_is_known_and_who_believes_drives_as_who_sees() -> None:
    engine, told = engine_of(BASE), ("gaps_m", "speeds_mps", "pair_hit", "time_s")
    for _ in range(10):
        now, taken = engine.worlds, believed(engine)
        for name in told:
            np.testing.assert_array_equal(getattr(taken, name), getattr(now, name))
        np.testing.assert_array_equal(taken.vehicles.mass_t, now.vehicles.mass_t)
        waiting = now.vehicles.latency_s > now.time_s[:, np.newaxis]
        np.testing.assert_array_equal(taken.vehicles.latency_s[waiting], now.vehicles.latency_s[waiting])
        engine.step(np.full((40, 1), -0.5))
    agents, worlds = (
        [make_agent(f"e_v2x_bm{way}", scenario=BASE) for way in ("", ":believed")],
        BASE.sample(40, 7).worlds,
    )
    harm, believing = (drive(worlds, agent, BASE, 1).ledger.world_harm("first") for agent in agents)
    np.testing.assert_allclose(believing, harm, atol=1e-4)


def test_believed__who_is_not_known_is_in_the_middle_of_the_ranges_and_follows_its_script() -> None:
    # Vehicle 3 is never heard: at the alert 7.5 m behind, at 20 m/s; it coasts to 0.8 s, then brakes with 6. At 1 s it
    # has made 20 m less 0.5 * 6 * 0.2^2 = 0.12 m, and Vehicle 2, with 20 m/s and no command, 20 m.
    scenario = BASE.replace(
        v2x=DEAF, gaps_m=[7.0, {"uniform": [5, 10]}], speeds_mps=[20.0, 20.0, {"uniform": [18, 22]}]
    )
    engine = engine_of(scenario)
    for _ in range(5):
        engine.step(np.zeros((40, 1)))
    taken = believed(engine)
    np.testing.assert_allclose(engine.worlds.time_s, 1.0)
    free = ~engine.worlds.pair_hit[:, 0] & (engine.worlds.speeds_mps[:, 1] == 20.0)
    assert free.sum() > 20
    np.testing.assert_allclose(taken.gaps_m[free, 1], 7.5 + 0.12)
    np.testing.assert_allclose(taken.speeds_mps[:, 2], 20.0 - 6.0 * 0.2)
    np.testing.assert_array_equal(taken.gaps_m[:, 0], engine.worlds.gaps_m[:, 0])
    assert (taken.command_mps2[:, 2] == -6.0).all() and not taken.pair_hit[:, 1].any()


def test_believed__an_old_message_is_moved_on_by_the_script_to_the_truth() -> None:
    channel = {
        "preset": "paper",
        "link_latency_s": 0.2,
        "persistence": "periodic",
        "senses": "front",
        "sensing_s": [5, 5],
    }
    engine = engine_of(BASE.replace(v2x=channel))
    odometer = Odometer.begun(engine.scenario.sample(40, 7).worlds, 1)
    for _ in range(12):
        now, told = engine.worlds, Told.to(engine.worlds, 1)
        assert told.known.all() and (told.at_s[:, [0, 2]] < now.time_s[:, np.newaxis] - 0.19).all()
        odometer = odometer.look(now, 1)
        taken = believed(engine, odometer=odometer)
        free = ~now.pair_hit.any(axis=1)
        np.testing.assert_allclose(taken.gaps_m[free], now.gaps_m[free], atol=1e-9)
        np.testing.assert_allclose(taken.speeds_mps[free], now.speeds_mps[free], atol=1e-9)
        engine.step(np.full((40, 1), -0.85))
    assert free.sum() > 3


@pytest.mark.parametrize(
    ("vehicles", "v2x"),
    [*((3, v2x) for v2x in (DEAF, PERIODIC, "blocked", "sensors-only")), (2, PERIODIC), (5, PERIODIC), (5, "blocked")],
)
def test_believing__drives_every_line_and_no_world_depends_on_the_batch(vehicles: int, v2x: object) -> None:
    scenario = eb.load_scenario("paper-random").replace(
        vehicles=vehicles, braking_capacity_mps2=6.0, driving_capacity_mps2=6.0, mass_t=5.0, latency_s=0.1, v2x=v2x,
        roles={"vehicle_2": "learner"}, horizon_s=12.0,
    )  # fmt: skip
    worlds = scenario.sample(6, 3).worlds
    for spec in ("e_v2x_bm:believed", "planner:8:believed"):
        agent = make_agent(spec, scenario=scenario)  # the same again for a batch of another size
        whole, alone = drive(worlds, agent, scenario, 1), drive(worlds.take([4]), agent, scenario, 1)
        assert whole.ledger.world_harm("first")[4] == alone.ledger.world_harm("first")[0]
        np.testing.assert_array_equal(whole.final.speeds_mps[4], alone.final.speeds_mps[0])


@pytest.mark.parametrize("v2x", ["paper", PERIODIC])
def test_believing__knows_of_the_obstacle_what_it_was_told(v2x: object) -> None:
    scenario = eb.load_scenario("cooperation-4-all").replace(early_impacts="keep", v2x=v2x).with_learners(["vehicle_2"])
    engine = engine_of(scenario)
    for _ in range(15):
        engine.step(np.full((40, 1), -0.9))
    told, now = Told.to(engine.worlds, 1), engine.worlds
    heard = told.known[:, 0]
    assert heard.sum() > 20
    np.testing.assert_allclose(told.obstacle_m[heard], (now.obstacle_gap_m + now.gaps_m[:, 0])[heard], atol=1e-9)
    assert np.isinf(told.obstacle_m[~heard]).all() and np.isfinite(believed(engine).obstacle_gap_m).all()
    drive(scenario.sample(5, 3).worlds, make_agent("e_v2x_bm:believed", scenario=scenario), scenario, 1)


def test_knowledge__of_an_agent_of_a_user_and_of_a_team() -> None:
    team = eb.Team({1: agent_of("ppo@shipped/ppo"), 2: agent_of("full_brake")}, "both")
    assert Knowledge.of(team) == (SENSORS, MESSAGES)
    assert Knowledge.of(eb.Team({}, "scripts")).text == "–"
    silent = Acts(lambda worlds, vehicle: np.zeros(worlds.n))
    assert Knowledge.of(silent).text == "not stated"
    assert not Knowledge.of(silent).sees_through
    assert Knowledge.of(silent, also=MODEL) == (MODEL, Source.UNSTATED)
    assert Knowledge.of(Leaking()) == (MESSAGES,)
