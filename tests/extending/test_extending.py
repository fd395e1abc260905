"""Parts that a user registers are trained with, evaluated, and shown in every output; refusals: ``test_refusals``."""

import csv
import json
import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import ethbrake_marl as eb
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.motion.layout import FIRST, MASS
from ethbrake_marl.worlds.scenario_file import new_scenario_text
from tests.training.tiny import TINY

near = pytest.approx
PAPER = eb.load_scenario("paper-random")
RURAL = {"preset": "nominal", "silent_links": 0.3, "link_latency_s": 0.2}
LISTED = ["own", "front_1", "rear_1.known", "urgency", "rear_1.load"]
MINE = f'''
import numpy as np
import ethbrake_marl as eb


def urgency(state, body):
    """Own speed for each metre to the vehicle ahead; 0 for the first."""
    if body == 1:
        return np.zeros(state.n)
    return state.speeds_mps[:, body - 1] / (1.0 + state.gaps_m[:, body - 2])


def load(state, body, other):
    """Mass of the neighbour for each tonne of the own."""
    return state.mass_t[:, other - 1] / state.mass_t[:, body - 1]


def calm(before, step, after):
    """Minus the own deceleration, per step."""
    return np.minimum(after.commands_mps2, 0.0)


def hurry(before, step, after):
    """Minus the mean speed of the line."""
    return -after.speeds_mps.mean(axis=1)


def front_first(harm, vehicle):
    """The harm of the front vehicle and of the own."""
    return harm.borne[:, 0] + harm.borne[:, vehicle]


def lost_speed(game, alert, last):
    """Speed that each vehicle has lost."""
    return alert.speeds_mps - last.speeds_mps


def worst(game, alert, last):
    """Largest harm that a vehicle bears."""
    return last.borne_harm("total").max(axis=1)


eb.register_feature("urgency", urgency, unit="1/s", scale=10.0, low=0.0, high=4.0)
eb.register_feature("load", load, unit="1", scale=1.0, low=0.0, high=8.0, of="neighbour", unknown=1.0)
eb.register_term("calm", calm, unit="m/s2")
eb.register_term("hurry", hurry, unit="m/s")
eb.register_preset("rural", {RURAL})
eb.register_objective("front-first", front_first)
eb.register_measure("lost_speed", lost_speed, unit="m/s")
eb.register_measure("worst", worst, unit="m2/s2")
'''


@pytest.fixture
def mine(tmp_path: Path) -> None:
    """The parts of the user's file are registered."""
    (tmp_path / "my_parts.py").write_text(MINE)
    runpy.run_path(str(tmp_path / "my_parts.py"))


def described(function: Any, told: str = "For a test.") -> Any:
    """A function with a docstring."""
    function.__doc__ = told
    return function


# ---------------------------------------------------------------- trainings


@pytest.mark.usefixtures("mine")
def test_parts__of_the_users_file_train_and_are_evaluated(tmp_path: Path) -> None:
    reward = {"harm": 1.0, "calm": 0.5, "hurry": 0.01}
    content = {**TINY.model_dump(mode="json"), "name": "mine", "observation": LISTED, "reward": reward}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(content))
    recipe = eb.load_recipe(tmp_path / "mine.yaml")
    scenario = PAPER.replace(objective="front-first", v2x="rural", early_impacts="keep")
    result = eb.train(recipe, scenario, tmp_path / "run", on_progress=None)
    policy = eb.load_policy(result.directory)
    manifest = policy.manifest
    assert manifest.observation.features[-3:] == ("rear_1.known", "urgency", "rear_1.load")
    assert (recipe.reward.terms, manifest.reward["terms"]) == ({"calm": 0.5, "hurry": 0.01},) * 2
    assert manifest.scenario["v2x"]["preset"] == "rural"
    harm = eb.evaluate(scenario, {"mine": eb.LearnedAgent(policy)}, episodes=10)["mine"]["first_impact_harm"]
    assert harm.mean() == near(result.metrics["first_impact_harm"], rel=1e-12)

    # Others may be added, and the scenario may list another observation.
    eb.register_feature(
        "mine", described(lambda state, body: np.ones(state.n)), unit="1", scale=2.0, low=-1.0, high=1.0
    )
    other = scenario.replace(observation=["mine", "own"])
    again = eb.evaluate(other, {"mine": eb.LearnedAgent(eb.load_policy(result.directory))}, episodes=10)
    assert again["mine"]["first_impact_harm"].tolist() == harm.tolist()
    assert [part.name for part in manifest.observation.registered] == ["urgency", "load"]


# ---------------------------------------------------------------- features and terms


@pytest.mark.usefixtures("mine")
def test_features__are_the_functions_scaled_and_clipped_and_unknown_where_nobody_is() -> None:
    worlds = eb.open_game(PAPER)[1].reset(PAPER.sample(50, 3))
    view = eb.View(["rear_1.gap", "urgency", "own", "front_1.load"])
    seen = view.observe(worlds, np.array([2]), 0.1)[:, 0]
    assert seen[:, 1] == near(worlds.speeds_mps[:, 1] / (1.0 + worlds.gaps_m[:, 0]) / 10.0, rel=1e-6)
    assert seen[:, 9] == near(worlds.car[:, MASS, 1] / worlds.car[:, MASS, 2], rel=1e-6)
    whole = eb.View().observe(worlds, np.array([2]), 0.1)[:, 0]
    assert seen[:, 2:9].tobytes() == whole[:, :7].tobytes()
    front = eb.View(["front_1.load", "urgency"]).observe(worlds, np.array([1]), 0.1)[:, 0]
    assert (front == [1.0, 0.0]).all()  # nobody is ahead of Vehicle 1
    silent = PAPER.replace(v2x={"hears": "front", "senses": "none"})  # whose channel hides a neighbour
    hidden = eb.make_sb3_vec_env(silent, 20, seed=1, observation=["rear_1.known", "rear_1.load"]).reset()
    assert not hidden[:, 0].any() and (hidden[:, 1] == 1.0).all()


@pytest.mark.parametrize(
    ("later", "message"),
    [
        (
            lambda after: np.array([[0.0] * 3, [0.0, 0.0, np.inf], [0.0] * 3]),
            "its value is inf for vehicle_3 in row 1 at 0.6 s; must be finite",
        ),
        (lambda after: after.speed_mps, r"its function fails: AttributeError: .*test_extending.py, line \d+"),
        (lambda after: after.line.fill(0.0), "its function fails: ValueError: .*read-only"),
    ],
)
def test_term__that_is_wrong_is_named_and_the_step_is_not_made(later: Any, message: str) -> None:
    eb.register_term("mine", described(lambda before, step, after: later(after)))
    scenario, game = eb.open_game(PAPER, reward={"harm": 1.0, "mine": 2.0})
    state = game.reset(scenario.sample(3, 7))
    before = [array.tobytes() for array in state[:5]]
    with pytest.raises(eb.EthBrakeError, match=f"term 'mine': {message}"):
        game.step(state, np.zeros((3, 1)))
    assert [array.tobytes() for array in state[:5]] == before


# ---------------------------------------------------------------- presets, objectives, measures


@pytest.mark.usefixtures("mine")
def test_preset__is_drawn_like_the_mapping_that_it_stands_for(tmp_path: Path) -> None:
    rural, spelt = (PAPER.replace(v2x=v2x, early_impacts="keep") for v2x in ("rural", RURAL))
    drawn = [scenario.sample(20, 3) for scenario in (rural, spelt)]
    assert drawn[0].latency_s.tobytes() == drawn[1].latency_s.tobytes()
    assert drawn[0].know.tobytes() == drawn[1].know.tobytes() != PAPER.sample(20, 3).know.tobytes()
    (tmp_path / "rural.yaml").write_text(yaml.safe_dump({**rural.declared(), "name": "rural"}))
    assert eb.load_scenario(tmp_path / "rural.yaml").v2x == rural.v2x
    clear = rural.replace(v2x={"preset": "rural", "silent_links": 0.0})
    assert (clear.v2x.silent_links, clear.v2x.link_latency_s) == (0.0, rural.v2x.link_latency_s)


@pytest.mark.usefixtures("mine")
def test_objective__is_paid_by_hand_and_can_be_reported() -> None:
    scenario, game = eb.open_game(PAPER.replace(objective="front-first"), reward="first-impact-harm")
    worlds = scenario.sample(6, 7)
    state, paid = game.reset(worlds), np.zeros((6, 3))
    while not state.ended.all():
        state, step = game.step(state, np.zeros((6, 1)))
        paid += step.reward
    borne = state.borne_harm("first")
    assert borne[:, 0].all() and -paid == near(borne + borne[:, :1])
    found = eb.evaluate(worlds, "coast", scenario=scenario, measures="front-first")["coast"]
    reported = np.stack([found[f"front-first_first_{i}"] for i in (1, 2, 3)], axis=1)
    assert reported == near(borne + borne[:, :1])


@pytest.mark.usefixtures("mine")
def test_measure__of_each_vehicle_stands_in_columns_json_and_frame_and_changes_nothing_else() -> None:
    plain, found = (eb.evaluate(PAPER, "full_brake", episodes=30, measures=each) for each in ("", "lost_speed,worst"))
    columns, row = found["full_brake"], eb.summarise(found).to_json()[0]
    for name, before in plain["full_brake"].items():
        assert before.tobytes() == columns[name].tobytes()
    assert columns["lost_speed_2"].mean() == near(row["lost_speed_2"]) and len(row["lost_speed_2_interval"]) == 2
    assert columns["worst"] == near(np.stack([columns[f"total_harm_{i}"] for i in (1, 2, 3)]).max(axis=0))
    assert found.to_pandas()["lost_speed_3"].to_numpy() == near(columns["lost_speed_3"])


# ---------------------------------------------------------------- folders and the command line


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

    words = ("evaluate", "--scenario", "hills", "--episodes", "5", "--agents", "full_brake", "--set", "measures=worst")
    (entry,) = json.loads(told(*words, "--output", str(tmp_path / "out"), "--per-world", "csv", "--json"))
    rows = list(csv.DictReader((tmp_path / "out" / "worlds.csv").read_text().splitlines()))
    assert entry["parameters"]["scenario"] == "hills"
    assert entry["worst"] == near(np.mean([float(row["worst"]) for row in rows]))
    origins = {entry["name"]: entry["origin"] for entry in json.loads(told("scenario", "list", "--json"))["scenarios"]}
    assert (origins["hills"], origins["paper-random"]) == (str(folder), "shipped")
    eb.register_scenarios(str(folder))  # twice is once
    added = [entry for entry in eb.list_scenarios() if entry not in before]
    assert [(entry.name, entry.origin) for entry in added] == [("coast-road", str(folder)), ("hills", str(folder))]
    assert eb.parallel_env(scenario="hills").reset(seed=1)[0] and {entry.origin for entry in before} == {"shipped"}


def test_objective__has_a_number_as_argument() -> None:
    """The function gets the number third; anything else is refused."""

    def capped(harm, vehicle, most):
        """Harm of all pairs, each at most a number."""
        return np.minimum(harm.pairs, most).sum(axis=1)

    eb.register_objective("capped", capped, arguments=float)
    scenario, game = eb.open_game(PAPER.replace(objective="capped:5"), reward="first-impact-harm")
    team = eb.Team.of({"vehicle_2": eb.make_agent("full_brake")}, "full_brake")
    paid, impacts = np.zeros(100), 0.0
    for step, state in eb.play(game, scenario.sample(100, seed=7), team):
        paid -= 0.0 if step is None else step.reward[:, 1]
        impacts = np.minimum(state.line[:, FIRST, :], 5.0).sum(axis=1)
    np.testing.assert_allclose(paid, impacts, atol=1e-12)
    assert paid.max() == 10.0
    with pytest.raises(eb.EthBrakeError, match="capped needs a number, as in capped:5"):
        scenario.replace(objective="capped:x")
