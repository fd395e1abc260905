"""Parts of the user's own: trained with, evaluated, told in every output; refusals: ``test_refusals``."""

import csv
import json
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import ethbrake_marl.first_edition as eb
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.first_edition.evaluation.statistics import mean
from ethbrake_marl.first_edition.game.measures import REPORTED
from ethbrake_marl.first_edition.game.objectives import standard_objectives
from ethbrake_marl.first_edition.game.observations import observe
from ethbrake_marl.first_edition.game.step_outcome import StepOutcome
from ethbrake_marl.first_edition.scenario.catalogue import new_scenario_text
from ethbrake_marl.first_edition.scenario.channel import CHANNELS
from tests.contract.interfaces import BARE
from tests.first_edition.learning.tiny import TINY_PPO

near = pytest.approx
PAPER = eb.load_scenario("paper-random")
SAMPLE = PAPER.sample(40, 7)
RURAL = {"preset": "nominal", "lost": 0.3, "message_period_s": 0.2}
LISTED = ["own", "front_1", "rear_1.known", "urgency", "rear_1.load"]
MINE = f'''
import numpy as np
import ethbrake_marl.first_edition as eb


def urgency(worlds, vehicle):
    """Own speed for each metre to the vehicle ahead; 0 for the first."""
    if vehicle == 0:
        return np.zeros(worlds.n)
    return worlds.speeds_mps[:, vehicle] / (1.0 + worlds.gaps_m[:, vehicle - 1])


def load(worlds, vehicle, neighbour):
    """Mass of the neighbour for each tonne of the own."""
    return worlds.vehicles.mass_t[:, neighbour] / worlds.vehicles.mass_t[:, vehicle]


def calm(step):
    """Minus the own deceleration, per step."""
    return np.minimum(step.command_mps2, 0.0)


def hurry(step):
    """Minus the mean speed of the line."""
    return -step.speeds_mps.mean(axis=1)


def front_first(harm, vehicle):
    """The harm of the front vehicle and of the own."""
    return harm.borne[:, 0] + harm.borne[:, vehicle]


def worst(episodes):
    """Largest change of speed in the line."""
    return episodes.largest_speed_change_mps.max(axis=1)


eb.register_feature("urgency", urgency, unit="1/s", scale=10.0, low=0.0, high=4.0)
eb.register_feature("load", load, unit="1", scale=1.0, low=0.0, high=8.0, of="neighbour", unknown=1.0)
eb.register_measure("calm", calm, unit="m/s2", by="step")
eb.register_measure("hurry", hurry, unit="m/s", by="step")
eb.register_preset("rural", {RURAL})
eb.register_objective("front-first", front_first)
eb.register_measure("worst", worst, unit="m/s")
'''


@pytest.fixture
def mine(tmp_path: Path) -> None:
    """The parts of the user's file are registered."""
    (tmp_path / "my_parts.py").write_text(MINE)
    runpy.run_path(str(tmp_path / "my_parts.py"))


def changed(function: Any, told: str = "Another one.") -> Any:
    """A function of another meaning."""
    function.__doc__ = told
    return function


def one(step: StepOutcome) -> Any:
    """One for all."""
    return np.ones(len(step.time_s))


def engine_of(worlds: int = 3, **settings: Any) -> eb.Engine:
    return eb.make_sb3_vec_env(PAPER, worlds, seed=1, **settings).engine


# ---------------------------------------------------------------- trainings


@pytest.mark.usefixtures("mine")
def test_parts__of_the_users_file_train_and_are_evaluated(tmp_path: Path) -> None:
    reward = {"harm": 1.0, "calm": 0.5, "hurry": 0.01}
    content = {**TINY_PPO.model_dump(mode="json"), "name": "mine", "observation": LISTED, "reward": reward}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump({**content, "total_steps": 1024}))
    recipe = eb.load_recipe(tmp_path / "mine.yaml")
    scenario = PAPER.replace(objective="front-first", v2x="rural", horizon_s=20, early_impacts="keep")
    result = eb.train(recipe, scenario, tmp_path / "run")
    policy = eb.load_policy(result.directory)
    manifest = policy.manifest
    assert manifest.observation.features[-3:] == ("rear_1.known", "urgency", "rear_1.load")
    assert (recipe.reward.terms, manifest.reward["terms"]) == ({"calm": 0.5, "hurry": 0.01},) * 2
    assert manifest.scenario["v2x"]["preset"] == "rural"
    told = {"mine": eb.LearnedAgent(policy, "mine"), "shipped": eb.make_agent("ppo", scenario=PAPER)}
    harm = eb.evaluate(scenario.sample(10, 7), told, scenario=scenario).outcome("mine").first_impact_harm
    assert harm.mean() == near(min(entry["first_impact_harm"] for entry in result.evaluations))

    # Others may be added, and the scenario may declare another observation.
    steady = changed(lambda worlds, vehicle: np.ones(worlds.n))
    eb.register_feature("mine", steady, unit="1", scale=2.0, low=-1.0, high=1.0)
    other = scenario.replace(observation=["mine", "own"])
    agent = {"mine": eb.LearnedAgent(eb.load_policy(result.directory))}
    again = eb.evaluate(other.sample(10, 7), agent, scenario=other)
    assert again.outcome("mine").first_impact_harm.tolist() == harm.tolist()
    assert [part.name for part in manifest.observation.registered] == ["urgency", "load"]


# ---------------------------------------------------------------- features and terms


@pytest.mark.usefixtures("mine")
def test_interfaces__observe_and_pay_the_same_and_infos_tell_the_terms() -> None:
    reward = {"harm": 0.0, "calm": 1.0, "hurry": 0.5}
    told = []
    for make in BARE.values():
        interface = make(PAPER, 1, reward=reward, observation=LISTED)
        start, turn = interface.reset(1), interface.step(np.full((1, 1), -0.5, np.float32))
        told.append((interface.space.shape, start.tobytes(), turn.bits()))
    assert told == [told[0]] * len(BARE) and told[0][0] == (20,)
    env = eb.parallel_env(scenario=PAPER.replace(observation=LISTED), reward=reward)
    vector = eb.EthBrakeVectorEnv(2, PAPER, reward=reward)
    seen, _ = env.reset(seed=1)
    vector.reset(seed=1)
    assert seen["vehicle_2"].tobytes() == told[0][1]  # also where the scenario declares it
    _, rewards, _, _, infos = env.step({"vehicle_2": np.array([-0.5], np.float32)})
    for agent, info in infos.items():
        assert {name for name in info if name.startswith("reward_")} == {"reward_calm", "reward_hurry"}
        assert info["reward_calm"] == min(info["command_in_force_mps2"], 0.0) and info["reward_hurry"] < 0.0
        assert rewards[agent] == info["reward_calm"] + 0.5 * info["reward_hurry"]
    columns = vector.step(np.full((2, 1), -0.5, np.float32))[4]
    assert columns["reward_calm"][0] == infos["vehicle_2"]["reward_calm"]


@pytest.mark.usefixtures("mine")
def test_columns__are_those_of_the_whole_observation_and_of_the_functions() -> None:
    worlds = PAPER.sample(50, 3).worlds
    whole = observe(worlds, 1, eb.ObservationSpec())
    names = [feature.name for feature in eb.ObservationSpec().features]
    seen = observe(worlds, 1, eb.choose_observation(["rear_1.gap", "urgency", "own", "front_1.load"]))
    assert seen[:, [0, *range(2, 9)]].tobytes() == whole[:, [names.index("rear_1.gap"), *range(7)]].tobytes()
    assert seen[:, 1] == near(worlds.speeds_mps[:, 1] / (1.0 + worlds.gaps_m[:, 0]) / 10.0, rel=1e-6)
    known, mass = whole[:, names.index("front_1.known")] == 1.0, worlds.vehicles.mass_t
    assert seen[:, 9] == near(np.where(known, mass[:, 0] / mass[:, 1], 1.0), rel=1e-6)
    assert (observe(worlds, 0, eb.choose_observation(["front_1.load"])) == 1.0).all()  # nobody is there
    assert eb.choose_observation(["own", "front_1", "rear_1"]) == eb.ObservationSpec()
    silent = PAPER.replace(v2x={"hears": "front", "senses": "none"})  # whose channel hides a neighbour
    hidden = eb.make_sb3_vec_env(silent, 20, seed=1, observation=["rear_1.known", "rear_1.load"]).engine.observe(1)
    assert not hidden[:, 0].any() and (hidden[:, 1] == 1.0).all()


def test_term__per_learner_leaves_the_others_out() -> None:
    own = changed(lambda step: np.broadcast_to(step.learners, (len(step.time_s), 2)))
    eb.register_measure("mine", own, by="step")
    env = eb.parallel_env(scenario=PAPER, reward={"harm": 0.0, "mine": 1.0}, learners=["vehicle_2", "vehicle_3"])
    env.reset(seed=1)
    assert list(env.step({"vehicle_2": [0.0], "vehicle_3": [0.0]})[1].values()) == [0.0, 1.0, 2.0]


@pytest.mark.parametrize(
    ("later", "message"),
    [
        (lambda step: np.array([0.0, 0.0, np.nan]), "is nan in world 2 at step 1; must be finite"),
        (lambda step: step.speed_mps, r"at step 1: its function fails: AttributeError: .*test_extending.py, line \d+"),
        (lambda step: step.speeds_mps.fill(0.0), "read-only"),
        (
            lambda step: np.zeros((3, 4)),
            r"at step 1: its function returned float64 of shape \(3, 4\); must return numbers",
        ),
        (
            lambda step: np.zeros((3, 3)),
            "its function returned a number per vehicle, but a number per world when it was",
        ),
    ],
)
def test_term__that_is_wrong_is_named_and_the_step_is_not_made(later: Any, message: str) -> None:
    term = changed(lambda step: later(step) if len(step.time_s) == 3 else np.zeros(len(step.time_s)))
    eb.register_measure("mine", term, by="step")
    engine = engine_of(reward={"harm": 1.0, "mine": 2.0})
    before = engine.packed.state.copy()
    with pytest.raises(InvalidInput, match=message):
        engine.step(np.zeros((3, 1)))
    assert engine.packed.state.tobytes() == before.tobytes()


# ---------------------------------------------------------------- presets, objectives, schemas


@pytest.mark.usefixtures("mine")
def test_preset__is_drawn_like_the_mapping_that_it_stands_for(tmp_path: Path) -> None:
    rural, spelt = (PAPER.replace(v2x=v2x, horizon_s=20, early_impacts="keep") for v2x in ("rural", RURAL))
    assert rural.v2x.channel == spelt.v2x.channel != CHANNELS["nominal"]
    latencies = [scenario.sample(20, 3).worlds.vehicles.latency_s.tobytes() for scenario in (rural, spelt)]
    assert latencies[0] == latencies[1]
    (tmp_path / "rural.yaml").write_text(rural.replace(name="rural").model_dump_json(exclude_unset=True))
    assert eb.load_scenario(tmp_path / "rural.yaml").v2x == rural.v2x
    assert rural.replace(v2x={"preset": "rural", "lost": 0.0}).v2x.channel.message_period_s == 0.2
    eb.register_preset("wired", {"preset": "nominal", "link_latency_s": 0.4})
    assert rural.replace(v2x="wired").v2x.channel.timing == "fixed"


@pytest.mark.usefixtures("mine")
def test_objective__is_paid_by_hand_and_stands_in_tables() -> None:
    found = eb.evaluate(SAMPLE, {"coast": eb.make_agent("coast")}, scenario=PAPER.replace(objective="front-first"))
    (row,) = (row for row in found.rescore() if (row.objective, row.harm_count) == ("front-first", "total"))
    borne = found.outcome("coast").ledger.vehicle_harm("total").mean(axis=0)
    assert [each.value for each in row.each] == near(borne + borne[0])
    assert standard_objectives()[-1] == "front-first"
    engine = engine_of(reward={"harm": 1.0, "objective": "front-first"})
    total = np.zeros((3, 3))
    while not engine.ended.all():
        total += engine.step(np.zeros((3, 1))).reward
    harm = engine.ledger.vehicle_harm("first")
    assert harm[:, 0].all() and total == near(-(harm[:, :1] + harm))


# ---------------------------------------------------------------- measures


def squared(episodes: Any) -> Any:
    """Squared closing speed of every impact."""
    rows = episodes.rows
    return np.bincount(rows.world, rows.closing_speed_mps**2, minlength=episodes.worlds.n)


def evaluated(**options: Any) -> Any:
    agents = {name: eb.make_agent(name, scenario=PAPER) for name in ("full_brake", "e_v2x_bm", "ppo+step")}
    return eb.evaluate(SAMPLE, agents, scenario=PAPER, **options)


def test_measure__sees_every_impact_whatever_the_chunk_and_changes_nothing_else() -> None:
    before = evaluated()
    eb.register_measure("squared", squared, unit="m2/s2")
    eb.register_measure("squared", squared, unit="m2/s2")  # twice is once
    whole, parts = evaluated(), evaluated(chunk=7)
    for name, outcome in whole.outcomes.items():
        assert outcome.metrics["squared"] == near(outcome.total_harm, rel=1e-9, abs=1e-9)
        assert outcome.metrics["squared"].tolist() == parts.outcome(name).metrics["squared"].tolist()
        assert before.outcome(name).metrics == {}
        assert before.outcome(name).total_harm.tobytes() == outcome.total_harm.tobytes()
    taken = whole.outcome("full_brake").take(np.array([3, 1]))
    assert taken.metrics["squared"].tolist() == whole.outcome("full_brake").metrics["squared"][[3, 1]].tolist()
    assert evaluated(aftermath=False).outcome("full_brake").metrics == {}


def test_measure__of_each_vehicle_stands_in_rows_frame_and_markdown() -> None:
    found = measured_by_vehicle()
    rows, braked = eb.summarise(found), found.outcome("full_brake")
    changes = np.stack([braked.metrics[f"change_{i}"] for i in (1, 2, 3)], axis=1)
    assert (((changes > 0.0).sum(axis=1) > 1) == braked.collided).all() and (changes >= 0.0).all()  # of both in a pair
    assert ((changes[:, 2] > 0.0) == braked.metrics["rear_ended"]).all() and np.ptp(changes[:, 2]) > 0.0
    assert [*rows[0].metrics][:4] == ["squared", "injured_1", "injured_2", "injured_3"]
    assert rows[1].metrics["injured_2"] == mean(found.outcome("e_v2x_bm").metrics["injured_2"])
    told = rows[0].to_json()
    assert told["metric_squared"] == near(told["total_harm"]) and len(told["metric_injured_3_interval"]) == 2
    assert told["metrics"]["injured_3"] == "injured, vehicle 3 (1)"
    frame = found.arrays()
    assert frame["metric_squared"] == near(frame["total_harm"])


def measured_by_vehicle() -> Any:
    eb.register_measure("squared", squared, unit="m2/s2")
    injury = changed(lambda episodes: 1.0 / (1.0 + np.exp(4.457 - 0.177 * episodes.largest_speed_change_mps)))
    eb.register_measure("injured", injury, unit="1")
    eb.register_measure("change", changed(lambda episodes: episodes.largest_speed_change_mps), unit="m/s")
    struck = changed(lambda each: np.isin(np.arange(each.worlds.n), each.rows.world[each.rows.pair == 1]))
    eb.register_measure("rear_ended", struck, unit="1")  # whether Vehicle 3 hit Vehicle 2
    return evaluated()


# ---------------------------------------------------------------- folders, the command line, the page


@pytest.mark.usefixtures("mine")
def test_folder__makes_its_scenarios_known_by_name_and_to_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, before = tmp_path / "mine", eb.list_scenarios()
    folder.mkdir()
    for name in ("hills", "coast-road"):
        (folder / f"{name}.yaml").write_text(new_scenario_text(name))
    eb.register_scenarios(folder)

    def told(*words: str) -> Any:
        assert run_command([*words]) == 0
        return capsys.readouterr().out

    words = ("evaluate", "--scenario", "hills", "--episodes", "5", "--agents", "full_brake")
    (entry,) = json.loads(told(*words, "--output", str(tmp_path / "out"), "--per-world", "csv", "--json"))
    rows = list(csv.DictReader((tmp_path / "out" / "worlds.csv").read_text().splitlines()))
    assert entry["parameters"]["scenario"] == "hills"
    assert entry["metric_worst"] == near(np.mean([float(row["metric_worst"]) for row in rows]))
    origins = {entry["name"]: entry["origin"] for entry in json.loads(told("scenario", "list", "--json"))}
    assert (origins["hills"], origins["paper-random"]) == (str(folder), "shipped")
    eb.register_scenarios(str(folder))  # twice is once
    added = [entry for entry in eb.list_scenarios() if entry not in before]
    assert [(entry.name, entry.origin) for entry in added] == [("coast-road", str(folder)), ("hills", str(folder))]
    assert eb.parallel_env(scenario="hills").reset(seed=1)[0] and {entry.origin for entry in before} == {"shipped"}
    assert "worst" in REPORTED
