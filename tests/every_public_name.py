"""A user's file that uses every public name: `make lint` gives it to mypy, tests/test_surface.py reads its names."""

from pathlib import Path
from typing import Any, assert_type

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.training.ppo import Ppo
from ethbrake_marl.training.recipe import PpoRecipe
from ethbrake_marl.training.training import Training


class Cautious:
    """An agent of one's own."""

    name, knows = "cautious", "own sensors"

    def begin(self, alert: eb.State, body: int) -> None:
        return None

    def act(self, state: eb.State, memory: None, body: int) -> tuple[Any, None]:
        return np.full(state.n, -1.0), memory


def make_cautious(argument: str | None, settings: eb.AgentSettings) -> eb.Agent:
    return Cautious()


class Icy(eb.Physics):
    """The exact physics with half of each learner's action."""

    def check(self, scenario: Any) -> None:
        return None

    def rewarding(self, game: eb.Game) -> Any:
        return game.rewarding

    def first_decision(self, game: eb.Game, alert: eb.State) -> eb.State:
        return game._replace(physics=None).first_decision(alert)

    def follow(self, game: eb.Game, state: eb.State, actions: Any) -> tuple[eb.State, eb.Step]:
        return game._replace(physics=None).follow(state, 0.5 * actions)


class Fog(eb.ChannelKey):
    """A key of ``v2x`` with a layer that changes nothing."""

    name = "fog"

    def layer(self, v2x: Any) -> eb.Layer:
        return eb.Layer()


class PatientRecipe(PpoRecipe):
    algorithm: str = "patient"
    patience: float = 0.995


class Patient(Ppo):
    """A learning algorithm of one's own."""

    def build(self, training: Training, environment: eb.EthBrakeVecEnv) -> Any:
        model, recipe = super().build(training, environment), training.recipe
        assert isinstance(recipe, PatientRecipe)
        model.gamma = model.rollout_buffer.gamma = recipe.patience
        return model


def weigh(count: eb.HarmCount) -> float:
    eb.register_count("pushes", [0, 1, 0, 10, 0, 0], column="pushes_cost", words="cost of pushes")
    return sum(count.weights)


def shield_of(game: eb.Game) -> eb.Shield | None:
    return game.shield


def unshielded(team: eb.Team, argument: str | None, settings: eb.AgentSettings) -> eb.Team:
    return team._replace(shield=None)


def smooth(before: eb.State, step: eb.Step, after: eb.State) -> Any:
    """Minus the deceleration."""
    return np.minimum(after.commands_mps2, 0.0)


def stopped_s(game: eb.Game, alert: eb.State, last: eb.State) -> Any:
    """When the episode ended."""
    return last.time_s


def register(recipe: type[eb.TrainingRecipe], algorithm: type[Any]) -> tuple[str, ...]:
    eb.register_agent("cautious", make_cautious)
    eb.register_shield("bare", unshielded)
    eb.register_algorithm("own", recipe, algorithm)
    eb.register_algorithm("patient", PatientRecipe, Patient)
    eb.register_term("smooth", smooth, unit="m/s2")
    eb.register_feature("load", lambda state, body: state.mass_t[:, body - 1], unit="t", scale=10.0, low=0.0, high=6.0)
    eb.register_feature_group("loads", [], lambda state, bodies, time_step_s: state.mass_t[:, bodies - 1, np.newaxis])
    eb.register_physics("icy", Icy())
    eb.register_v2x_key("fog_m", Fog())
    eb.register_preset("deaf", {"preset": "nominal", "silent_links": 0.5})
    eb.register_objective("front", lambda harm, vehicle: harm.borne[:, 0])
    eb.register_measure("stopped_s", stopped_s, unit="s")
    driver: eb.Agent = eb.policy_agent(lambda seen: -abs(seen[:, :1]), name="mine", clip=True)
    braking: eb.Agent = eb.policy_agent(abs, actions=eb.ActionScale(offset=-0.9, scale=0.3))
    eb.register_scenarios("my_scenarios")
    part: eb.Part = eb.Part(make_cautious, about="careful")
    return (driver.name, braking.name, *part.settings)


def interfaces() -> list[Any]:
    reward, view = eb.RewardParams(harm=2.0), eb.View(["own", "front_1"])
    batch: eb.EthBrakeVecEnv = eb.make_sb3_vec_env("paper-random", 4, reward=reward, observation=view)
    parallel: eb.EthBrakeParallelEnv = eb.parallel_env(scenario="paper-random")
    return [
        *(eb.EthBrakeEnv(), eb.EthBrakeVectorEnv(num_envs=4), eb.env(), eb.raw_env()),
        *(eb.shield(parallel), eb.shield(batch, "ppo"), eb.shield(Cautious(), scenario="paper-random")),
        eb.ShieldReason(3).text,
    ]


def play_by_hand() -> float:
    scenario, game = eb.open_game("paper-random", reward="total-harm")
    assert_type(scenario, eb.Scenario)
    assert_type(game, eb.Game)
    worlds: eb.State = scenario.sample(10, 7)
    state = game.reset(game.draw(10, seed=7, first=0))
    state = game.reset(worlds)
    harm = eb.price(game, state, np.full((10, 1, 1), -1.0), "total")
    held = eb.hold(state, state.wanted, [2], np.full((10, 3, 1), -2.0), 8.0, "first")
    after, step = game.step(state, np.zeros((10, 1)))
    assert_type(step, eb.Step)
    team = eb.Team.of({"vehicle_2": Cautious()}, "cautious")
    last = eb.play_to_end(game, worlds, team)
    states = [state for _, state in eb.play(game, worlds, team)]
    driver = eb.Driver("plan", worlds, scenario=scenario)
    driver.decide(driver.first_s, after.gaps_m, after.speeds_mps, after.forces_mps2, after.pair_hit)
    return float(harm.sum() + held.sum() + after.n + last.harm("total").sum() + len(states))


def learn(folder: Path) -> eb.TrainResult:
    def tell(progress: eb.Progress) -> None:
        return None

    recipe: eb.TrainingRecipe = eb.load_recipe("ppo")
    try:
        result = eb.train(recipe, "paper-random", folder, steps=1000, on_progress=tell)
    except eb.EthBrakeError:
        result = eb.resume(folder)
    assert_type(result, eb.TrainResult)
    return result


def measure(folder: Path) -> list[eb.SummaryRow]:
    scenario = eb.load_scenario(eb.list_scenarios()[0].name)
    eb.read_worlds(scenario, "mine.csv")
    worlds: eb.State = eb.worlds_from_table(scenario, {"gap_1_m": [7.0], "gap_2_m": [7.0]})
    policies: list[eb.Policy] = [eb.load_policy(folder), eb.load_shipped("ppo")]
    agents = {"full_brake": "full_brake", "learned": eb.LearnedAgent(policies[0]), "ppo": eb.make_agent("ppo")}
    found: eb.Result = eb.evaluate(worlds, agents, scenario=scenario, measures="pushed_mps,pushed_m")
    record: eb.EpisodeRecord = eb.record_episode(worlds, Cautious(), scenario=scenario)
    assert record.last.harm("first").shape == found["learned"]["first_impact_harm"].shape
    return eb.summarise(found)


def show(found: eb.Result, folder: Path) -> list[Any]:
    table = eb.summarise(found)
    assert_type(table, eb.SummaryTable)
    assert_type(eb.summarise_by(found, "scenario"), dict[str, eb.SummaryTable])
    eb.write_results(folder, table, found, "csv")
    eb.write_rows(folder / "rows.csv", found)
    assert_type(eb.read_result(folder / "results.json"), dict[str, dict[str, Any]])
    return [found.to_pandas(), table.to_pandas()]


def version() -> str:
    try:
        return eb.__version__
    except eb.MissingExtra as missing:
        return str(missing)
