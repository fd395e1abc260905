"""What a message contains (``v2x: tells``): observations by hand, and who refuses to go on without a piece."""

import re
from typing import Any

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.agents.driving import script_agents
from ethbrake_marl.first_edition.game.observations import choose_observation, observe
from ethbrake_marl.first_edition.physics.messages import PIECES, USUAL_PIECES
from tests.first_edition.rest.fixture_knowledge import alter_unreceived

PAPER = eb.load_scenario("paper-random")
LINE = eb.Scenario(
    name="by-hand", gaps_m=[8, 6], speeds_mps=[20, 18, 22], braking_capacity_mps2=[6, 7, 5], driving_capacity_mps2=3,
    latency_s=[0, 0.5, 1.0], mass_t=[4.5, 5.5, 5.9], restitution=0.1, roles={"vehicle_2": "learner"},
)  # fmt: skip
SEEN = ["own", "front_1", "rear_1", "front_1.intent", "rear_1.intent"]
BLOCK = ("known", "gap", "closing_speed", "acceleration", "braking_capacity", "mass", "latency_left", "hit",
         "stopping_margin", "fitting_deceleration")  # fmt: skip
FRONT = {  # what Vehicle 2 sees of Vehicle 1 after 0.5 s, of which Vehicle 1 has braked with 6 m/s2
    "known": 1.0, "gap": (8 + 9.25 - 9) / 10, "closing_speed": (18 - 17) / 10, "acceleration": -0.6,
    "braking_capacity": 0.6, "mass": 0.45, "latency_left": 0.0, "hit": 0.0,
    "stopping_margin": (8.25 + 17**2 / 12 - 18**2 / 14) / 10,
    "fitting_deceleration": 18**2 / (2 * (8.25 + 17**2 / 12)) / 10,
}  # fmt: skip
REAR = {  # and of Vehicle 3, which may not act before 1 s
    "known": 1.0, "gap": (6 + 9 - 11) / 10, "closing_speed": (22 - 18) / 10, "acceleration": 0.0,
    "braking_capacity": 0.5, "mass": 0.59, "latency_left": 0.5, "hit": 0.0,
    "stopping_margin": max((4 + 18**2 / 14 - (22 * 0.5 + 22**2 / 10)) / 10, -15.0),
    "fitting_deceleration": 18**2 / (2 * (22 * 0.5 + 22**2 / 10 - 4)) / 10,
}  # fmt: skip


def engine_of(scenario: eb.Scenario, seen: object = None, n: int = 1) -> eb.Engine:
    scripts = script_agents(scenario, except_for=scenario.learners)
    worlds = scenario.sample(n, 7).worlds
    return eb.Engine(scenario, n, learners=scenario.learners, scripts=scripts, worlds=worlds, observation=seen)


def seen_by(engine: eb.Engine, vehicle: int) -> dict[str, float]:
    spec = engine.observations[vehicle]
    return dict(zip([f.name for f in spec.features], engine.observe(vehicle)[0].tolist(), strict=True))


def block(wanted: dict[str, float], *features: str) -> dict[str, float]:
    return {name: value if name in features else 0.0 for name, value in wanted.items()}


def check(told: dict[str, float], side: str, wanted: dict[str, float]) -> None:
    assert {name: told[f"{side}.{name}"] for name in wanted} == pytest.approx(wanted, abs=1e-6)


def test_by_hand__messages_that_contain_place_and_speed_alone() -> None:
    each = [f"{side}.{piece}_known" for side in ("front_1", "rear_1") for piece in PIECES]
    told = seen_by(engine_of(LINE.replace(v2x={"tells": ["speed", "place"]}), [*SEEN, *each]), 1)
    check(told, "front_1", block(FRONT, "known", "gap", "closing_speed"))
    check(told, "rear_1", block(REAR, "known", "gap", "closing_speed"))
    assert [told[name] for name in each] == 2 * [1.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    assert told["own.braking_capacity"] == pytest.approx(0.7) and told["rear_1.intent"] == 0.0


def test_by_hand__each_vehicle_tells_something_else() -> None:
    tells = {"vehicle_1": ["speed", "braking_capacity", "latency"], "vehicle_2": ["intent"], "vehicle_3": [*PIECES]}
    engine = engine_of(LINE.replace(v2x={"tells": tells}), SEEN)
    told = seen_by(engine, 1)
    check(told, "front_1", block(FRONT, "known", "closing_speed", "braking_capacity"))
    check(told, "rear_1", REAR)
    # Vehicle 3 chose full braking at the alert; it is not in force before 1 s. Vehicle 1 does not tell its own.
    assert (told["rear_1.intent"], told["front_1.intent"]) == (pytest.approx(-0.5), 0.0)
    chosen = []
    for action in (-0.5, 1.0, 0.0):  # of the capacities 7 and 3 m/s2
        chosen.append(seen_by(engine, 0)["rear_1.intent"])
        check(seen_by(engine, 0), "rear_1", {"known": 1.0, **dict.fromkeys(BLOCK[1:], 0.0)})
        engine.step(np.array([[action]]))
    assert [*chosen, seen_by(engine, 0)["rear_1.intent"]] == pytest.approx([0.0, -0.35, 0.3, 0.0])


def test_by_hand__messages_that_go_on_carry_what_they_contain_and_grow_old() -> None:
    # Every 0.1 s one is sent, of use 0.2 s later, and every second one is lost: (p, r) = (1, 1). At 0.5 s the newest is
    # that of 0.2 s. Vehicle 1 was 3.88 m on then, and as fast as 18.8 m/s; Vehicle 2 is 9 m on.
    v2x = {"link_latency_s": 0.2, "senses": "none", "persistence": "periodic", "loss_begins": 1.0, "loss_ends": 1.0}
    aged = [*SEEN, "front_1.age", "rear_1.age"]
    place = 20 * 0.2 - 3 * 0.2**2
    told = seen_by(engine_of(LINE.replace(v2x={**v2x, "tells": ["place"]}), aged), 1)
    assert told["front_1.gap"] == pytest.approx((8 + place - 9) / 10, abs=1e-6)
    assert told["front_1.age"] == pytest.approx(0.3, abs=1e-6) and told["front_1.closing_speed"] == 0.0
    told = seen_by(engine_of(LINE.replace(v2x={**v2x, "tells": ["place", "speed"]}), aged), 1)
    assert told["front_1.gap"] == pytest.approx((8 + place + 18.8 * 0.3 - 9) / 10, abs=1e-6)
    assert told["front_1.closing_speed"] == pytest.approx((18 - 18.8) / 10, abs=1e-6)
    told = seen_by(engine_of(LINE.replace(v2x={**v2x, "tells": ["place", "speed", "acceleration"]}), aged), 1)
    assert told["front_1.gap"] == pytest.approx(FRONT["gap"], abs=1e-6)
    assert told["front_1.closing_speed"] == pytest.approx(FRONT["closing_speed"], abs=1e-6)
    # Decisions at 0.5, 0.6, 0.7, ... The sample of 0.6 s has the choice of 0.5 s; Vehicle 1 uses it from 0.8 s on.
    engine, seen = engine_of(LINE.replace(v2x={**v2x, "tells": {"vehicle_2": ["intent"]}}), aged), []
    for action in (-0.1, -0.2, -0.3, -0.4, -0.5, -0.6):
        seen.append(seen_by(engine, 0)["rear_1.intent"])
        engine.step(np.array([[action]]))
    assert [*seen, seen_by(engine, 0)["rear_1.intent"]] == pytest.approx([0, 0, 0, -0.07, -0.07, -0.21, -0.21])
    assert seen_by(engine, 0)["rear_1.age"] == pytest.approx(0.3, abs=1e-6)


def test_in_sight__sensors_measure_place_speed_and_acceleration_and_no_more() -> None:
    v2x = {"link_latency_s": 0.0, "senses": "front", "sensing_s": [0.7, 0.7], "tells": ["mass"]}
    engine = engine_of(LINE.replace(v2x=v2x), SEEN)
    check(seen_by(engine, 1), "front_1", block(FRONT, "known", "mass"))
    for _ in range(2):
        engine.step(np.array([[0.0]]))
    told = seen_by(engine, 1)  # after 0.7 s
    assert (told["front_1.gap"], told["front_1.closing_speed"], told["front_1.acceleration"]) == pytest.approx(
        ((8 + 20 * 0.7 - 3 * 0.49 - 18 * 0.7) / 10, (18 - 20 + 6 * 0.7) / 10, -0.6), abs=1e-6
    )
    assert told["front_1.mass"] == pytest.approx(0.45) and told["front_1.braking_capacity"] == 0.0
    check(told, "rear_1", block(REAR, "known", "mass"))


def test_intent__who_waits_for_news_has_chosen_nothing() -> None:
    # Vehicle 2 hears Vehicle 3 from the alert on. Vehicle 3 hears nobody: it sees Vehicle 2 brake after 1 s, and has
    # chosen nothing before, though its script is full braking and its own latency is 0.
    v2x = {"link_latency_s": 0.0, "sensing_s": [1.0, 1.0], "senses": "both", "tells": [*PIECES]}
    scenario = LINE.replace(v2x={**v2x, "vehicles": {"vehicle_3": {"hears": "none"}}}, latency_s=[0, 0, 0])
    assert scenario.sample(1, 7).worlds.vehicles.latency_s.tolist() == [[0.0, 0.0, 1.0]]
    engine, seen = engine_of(scenario, SEEN), []
    for _ in range(11):
        engine.step(np.array([[0.0]]))
        seen.append(seen_by(engine, 1)["rear_1.intent"])
    assert seen[:9] == 9 * [0.0] and seen[10] == pytest.approx(-0.5)


CHANNELS_HERE = [
    "paper", "nominal", "blocked", {"preset": "blocked", "persistence": "periodic"}, {"hears": "front"},
    {"preset": "congested", "persistence": "periodic", "senses": "front"},
]  # fmt: skip
MUCH = ["own", "front_1", "rear_1", "role", "obstacle", "contact", "front_1.age", "rear_1.build_up_time"]


def over(channel: object, tells: object, base: str = "cooperation-2-paper") -> eb.Scenario:
    given = {"preset": channel} if isinstance(channel, str) else channel
    return eb.load_scenario(base).replace(v2x=given if tells is None else {**given, "tells": tells})


@pytest.mark.parametrize("channel", CHANNELS_HERE, ids=str)
def test_tells__written_out_the_usual_pieces_change_no_bit(channel: object) -> None:
    for base in ("cooperation-2-paper", "cooperation-4-all"):
        engines = [engine_of(over(channel, tells, base), MUCH, 40) for tells in (None, [*USUAL_PIECES], [*PIECES])]
        for k in range(12):
            seen = [engine.observe_all(np.arange(3)).tobytes() for engine in engines]
            assert seen[0] == seen[1] == seen[2]
            for engine in engines:
                engine.step(np.full((40, len(engine.learners)), 0.3 - 0.1 * k))


@pytest.mark.parametrize("without", PIECES)
@pytest.mark.parametrize("channel", CHANNELS_HERE, ids=str)
def test_tells__what_no_message_contains_changes_no_bit_of_an_observation(channel: object, without: str) -> None:
    scenario, rng = over(channel, [piece for piece in PIECES if piece != without]), np.random.default_rng(3)
    engine, known = engine_of(scenario, n=50), [f"{side}.{without}_known" for side in ("front_1", "rear_1")]
    spec, seen = choose_observation([*SEEN, *known, "front_1.age", "contact"], scenario.time_step_s), 0.0
    for _ in range(10):
        told = observe(engine.worlds, 1, spec)
        assert observe(alter_unreceived(engine.worlds, 1, rng), 1, spec).tobytes() == told.tobytes()
        seen += told[:, [k for k, f in enumerate(spec.features) if f.name in known]].sum()
        engine.step(np.full((50, 1), -0.4))
    sees = scenario.v2x.channel.senses != "none"
    assert (seen > 0.0) == (sees and without in ("place", "speed", "acceleration"))  # of who is in sight


def test_obstacle__is_known_of_with_the_place_of_vehicle_1() -> None:
    base = LINE.replace(obstacle_gap_m=60, v2x={"tells": {"vehicle_1": ["speed"]}})
    listed = ["own", "front_1", "obstacle"]
    assert seen_by(engine_of(base, listed), 1)["obstacle.known"] == 0.0
    assert seen_by(engine_of(base, listed), 0)["obstacle.known"] == 1.0
    assert seen_by(engine_of(base.replace(v2x={"tells": ["place"]}), listed), 1)["obstacle.known"] == 1.0


def test_contact__a_pair_reads_nothing_where_a_piece_is_missing() -> None:
    told = seen_by(engine_of(LINE.replace(v2x={"tells": {"vehicle_1": [*USUAL_PIECES[:-1]]}}), ["contact"]), 1)
    assert told["contact.brake_front_time"] == 0.0 and told["contact.brake_rear_time"] > 0.0


@pytest.mark.parametrize(
    ("v2x", "message"),
    [
        ({"tells": ["plce"]}, "v2x.tells[0] = plce: did you mean place?; known: place, speed, acceleration,"),
        (
            {"tells": {"vehicle_9": []}},
            "v2x.tells.vehicle_9: unknown vehicle; this scenario has vehicle_1 ... vehicle_3",
        ),
        (
            {"tells": {}},
            "v2x.tells = {}: must be a list of items from place, speed, acceleration, braking_capacity, latency",
        ),
        ({"tells": ["mass", "mass"]}, "v2x.tells = [mass, mass]: must not list an item twice"),
        ({"tells": {"vehicle_2": "mass"}}, "v2x.tells.vehicle_2 = mass: must be a list of items from place, speed"),
        (
            {"preset": "sensors-only", "tells": ["mass"]},
            "v2x.tells = [mass]: has no effect, because hears: none means that no",
        ),
        (
            {"preset": "nominal", "tells": {"vehicle_3": []}, "vehicles": {"vehicle_3": {"sends": False}}},
            "v2x.tells.vehicle_3: has no effect, because vehicle_3 sends no messages",
        ),
    ],
)
def test_tells__what_cannot_be_is_refused(v2x: dict, message: str) -> None:
    with pytest.raises(InvalidInput, match=re.escape(message)):
        PAPER.replace(v2x=v2x)


LIGHT = PAPER.replace(v2x={"tells": {"vehicle_3": [*USUAL_PIECES[:-1]]}})  # Vehicle 3 does not tell its mass


@pytest.mark.parametrize(
    ("spec", "refuses"),
    [
        ("full_brake", False), ("ppo", False), ("e_v2x_bm", True), ("e_v2x_bm:pairwise", False),
        ("ppo+step", True), ("ppo+episode", True), ("full_brake+episode:pairwise", True),
    ],
)  # fmt: skip
def test_agents__who_looks_ahead_refuses_to_do_without_a_piece(spec: str, refuses: bool) -> None:
    def evaluation() -> eb.Evaluation:
        agents = {spec: eb.make_agent(spec, scenario=LIGHT)}
        return eb.evaluate(LIGHT.sample(6, 7), agents, scenario=LIGHT)

    if not refuses:
        assert evaluation().hidden.all()  # as over a channel that hides something
        return
    with pytest.raises(
        InvalidInput, match=r"vehicle_3 do not contain its mass \(key v2x.tells\), .*, mass of the other vehicles are"
    ):
        evaluation()


@pytest.mark.parametrize(
    ("tells", "told"),
    [
        (["place", "speed"], "; messages of all contain place, speed"),
        ({"vehicle_3": []}, "; messages of vehicle_3 contain the alert alone"),
        (None, ""),
    ],
)
def test_results__say_what_messages_contain(tells: Any, told: str) -> None:
    scenario = eb.load_scenario("paper-random").replace(v2x={} if tells is None else {"tells": tells})
    rows = eb.summarise(eb.evaluate(agents="full_brake", scenario=scenario, episodes=3))
    assert rows[0].parameters.get("tells") == tells and rows[0].parameters.line.endswith(f"e\u00a0=\u00a00.1{told}")
