"""A user's file that uses every public name: `make lint` gives it to mypy, tests/test_surface.py reads its names."""

from pathlib import Path
from typing import Any, assert_type

import numpy as np

import ethbrake_marl as eb
from ethbrake_marl.extensions.cooperation import (
    Equilibrium,
    Spread,
    best_joint_harm,
    compare_starts,
    find_equilibria,
    price_of_anarchy,
)
from ethbrake_marl.extensions.datasets import to_parquet
from ethbrake_marl.extensions.report.deceleration import deceleration_curve, deceleration_figure
from ethbrake_marl.extensions.report.episode_figure import trajectories
from ethbrake_marl.extensions.report.run_figures import harm_against_total_gap
from ethbrake_marl.extensions.report.style import write_picture


class Cautious:
    """An agent of one's own."""

    name = "cautious"

    def act(self, worlds: eb.Worlds, vehicle: int) -> Any:
        return np.full(worlds.n, -1.0)


def make_cautious(argument: str | None, settings: eb.AgentSettings) -> eb.Agent:
    return Cautious()


def register(recipe: type[eb.TrainingRecipe], algorithm: type[Any]) -> tuple[str, ...]:
    eb.register_agent("cautious", make_cautious)
    eb.register_algorithm("own", recipe, algorithm)
    eb.register_measure("smooth", lambda step: -np.abs(step.command_mps2), unit="m/s2", by="step")
    eb.register_feature("load", lambda worlds, i: worlds.vehicles.mass_t[:, i], unit="t", scale=10.0, low=0.0, high=6.0)
    eb.register_preset("deaf", {"preset": "nominal", "lost": 0.5})
    eb.register_objective("front", lambda harm, vehicle: harm.borne[:, 0])
    eb.register_measure("delta_v", lambda episodes: episodes.largest_speed_change_mps, unit="m/s")
    driver: eb.Agent = eb.policy_agent(lambda seen: -abs(seen[:, :1]), name="mine", clip=True)
    eb.register_scenarios("my_scenarios")
    part: eb.Part = eb.Part(make_cautious, about="careful")
    return (driver.name, *part.settings, *eb.agent_names())


def interfaces(policy: eb.Policy) -> list[Any]:
    reward, engine = eb.RewardParams(harm=2.0), eb.make_engine("paper-random", 4)
    observation = eb.ObservationSpec(front=2) if reward.harm else eb.choose_observation(["own", "front_1"])
    batch: eb.EthBrakeVecEnv = eb.make_sb3_vec_env("paper-random", 4, reward=reward, observation=observation)
    parallel: eb.EthBrakeParallelEnv = eb.parallel_env(scenario="paper-random")
    assert_type(engine, eb.Engine)
    return [
        eb.CostEnv(eb.EthBrakeEnv()),
        *(eb.EthBrakeVectorEnv(num_envs=4), eb.env(), eb.raw_env(), eb.ShieldOptions(mode="step")),
        *(eb.HybridShield(parallel, policy, mode="step"), eb.shielded_aec(parallel, mode="step"), eb.shield(parallel)),
        *(eb.ShieldedEnv(eb.EthBrakeEnv()), eb.ShieldedVectorEnv(eb.EthBrakeVectorEnv()), eb.ShieldedVecEnv(batch)),
        *(eb.ShieldReason(3).text, eb.ShieldMode.STEP.name),
    ]


def worlds_of(name: str) -> eb.Worlds:
    scenario = eb.load_scenario(name)
    assert_type(scenario, eb.Scenario)
    assert_type(eb.observation_for(scenario), eb.ObservationSpec)
    sample: eb.Sample = scenario.sample(10, 7)
    moved, _ = eb.advance(sample.worlds, -5.0, 0.1)
    return moved


def line() -> eb.Worlds:
    return eb.make_worlds(
        [7.0], [20.0, 20.0], braking_capacity_mps2=6.0, driving_capacity_mps2=3.0, latency_s=0.5, mass_t=5.0,
        restitution=0.1,
    )  # fmt: skip


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
    eb.worlds_from_table(scenario, {"gap_1_m": [7.0], "gap_2_m": [7.0]})
    policies = [eb.load_policy(folder), eb.load_shipped("ppo")]
    team: eb.Team = eb.Team({1: eb.LearnedAgent(policies[0])}, "learned")
    agents = {"full_brake": eb.make_agent("full_brake"), "learned": team}
    found: eb.Evaluation = eb.evaluate(scenario.sample(10, 7), agents, scenario=scenario)
    outcome: eb.Outcome = found.outcome("learned")
    record: eb.EpisodeRecord = eb.record_episode(found.worlds.take([0]), Cautious(), scenario=scenario)
    assert record.ledger.world_harm("first").shape == outcome.first_impact_harm[:1].shape
    to_parquet(folder / "brakes.parquet", agents, scenario=scenario, episodes=10)
    return eb.summarise(found)


def show(found: eb.Evaluation, folder: Path) -> list[Any]:
    record = eb.record_episode(found.worlds.take([0]), Cautious(), scenario=found.scenario)
    write_picture(folder / "episode.svg", trajectories({"world 0": record}))
    eb.compare_results(eb.read_result(folder / "a.json"), eb.read_result(folder / "b.json"))
    curve = deceleration_curve(found.worlds.take([0]), found.task)
    assert_type(eb.summarise(found), eb.SummaryTable)
    assert_type(eb.summarise_by(found, "scenario"), dict[str, eb.SummaryTable])
    figures = [deceleration_figure(curve), harm_against_total_gap(found)]
    return [found.to_pandas(), eb.summarise(found).to_pandas(), *figures]


def play(level: eb.Scenario, worlds: eb.Worlds) -> float:
    ends = find_equilibria(level, worlds, "own", budget=300)
    assert_type(ends, dict[str, Equilibrium])
    spread: Spread = compare_starts(ends, "first")
    price = price_of_anarchy(spread.worst, best_joint_harm(level, worlds, ends.values(), budget=300)["first"])
    return price.value if price else 1.0


def version() -> str:
    try:
        return eb.__version__
    except eb.MissingExtra as missing:
        return str(missing)
