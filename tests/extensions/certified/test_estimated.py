"""Shields over estimated worlds: the bound in worlds that are corners of what is open, and in others."""

from typing import Any

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.first_edition.agents.driving import drive
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.physics.state import Floats
from ethbrake_marl.first_edition.shields.wrappers import HybridShield, ShieldedEnv, ShieldedVectorEnv, shielded_aec
from tests.extensions.certified.estimates import ABOVE, HEARD_LATE, LISTS, NEVER_HEARD, WAYS, shielded
from tests.first_edition.shield.attacks import all_infos
from tests.first_edition.shield.plays import reported

BASE = eb.load_scenario("cooperation-2-paper").replace(early_impacts="keep")
PERIODIC = BASE.replace(v2x={"preset": "blocked", "persistence": "periodic"})


def driven(agent: object, scenario: eb.Scenario, n: int, seed: int = 7, vehicle: int = 1) -> tuple[Floats, Floats]:
    """Harm realised, and the first bound, [n] each."""
    episodes = drive(scenario.sample(n, seed).worlds, agent, scenario, vehicle)
    told = episodes.memories[vehicle] if episodes.guarded is None else episodes.guarded.results
    return episodes.ledger.world_harm("first"), told["predicted_harm"]


@pytest.mark.parametrize("name", LISTS)
@pytest.mark.parametrize("way", WAYS)
def test_robust__at_the_corners_no_world_is_above_the_first_bound(name: str, way: str) -> None:
    harm, bound, replaced = shielded(way, LISTS[name], 4, 7)
    assert (harm <= bound + ABOVE).all() and replaced > 4


def test_robust__between_the_corners_some_worlds_are_above_though_trusted() -> None:
    """The counterexample of docs/extensions/certified.md: proposals to coast, in the first world of seed 5006."""
    env = eb.HybridShield(eb.parallel_env("cooperation-1-front"), mode="robust", estimated=True)
    env.reset(seed=5006)
    told = []
    while env.agents:
        told.append(env.step({"vehicle_2": [0.0]})[4]["vehicle_2"])
        assert told[-1]["shield_trusted"]
    assert told[-1]["world_first_impact_harm"] > told[0]["shield_bound_harm"] + 8.0


def test_step__in_the_middle_promises_nothing_of_the_corners() -> None:
    harm, bound, _ = shielded("coast", NEVER_HEARD, 30, 7, robust=False)
    assert (harm > bound + 1.0).any()


@pytest.mark.parametrize("robust", [False, True])
def test_estimated__where_everything_is_known_the_bound_is_that_of_the_best_constant(robust: bool) -> None:
    harm, bound, _ = shielded("drive", BASE, 20, 7, robust=robust)
    _, best = driven(make_agent("e_v2x_bm", scenario=BASE), BASE, 20)
    np.testing.assert_allclose(bound, best, atol=1e-4)
    assert (harm <= bound + 1e-6).all()


@pytest.mark.parametrize("spec", ["coast+step:estimated", "coast+robust:estimated", "ppo+episode:estimated"])
def test_estimated__no_world_depends_on_the_batch(spec: str) -> None:
    worlds = PERIODIC.sample(5, 3).worlds
    whole = drive(worlds, make_agent(spec, scenario=PERIODIC), PERIODIC, 1).final
    alone = drive(worlds.take([4]), make_agent(spec, scenario=PERIODIC), PERIODIC, 1).final
    np.testing.assert_allclose(whole.speeds_mps[4], alone.speeds_mps[0], atol=1e-6)


@pytest.mark.parametrize(
    "scenario",
    [
        eb.load_scenario("paper-random").replace(
            vehicles=2, braking_capacity_mps2=6.0, driving_capacity_mps2=6.0, mass_t=5.0, latency_s=0.1,
            roles={"vehicle_2": "learner"}, v2x={"preset": "nominal", "persistence": "periodic"}, horizon_s=10.0,
        ),
        eb.load_scenario("cooperation-4-all").with_learners(["vehicle_2"]).replace(
            early_impacts="keep", v2x=PERIODIC.v2x.model_dump(exclude_none=True)
        ),
    ],
    ids=["two vehicles", "an obstacle"],
)  # fmt: skip
@pytest.mark.parametrize("robust", [False, True])
def test_estimated__shields_other_lines(scenario: eb.Scenario, robust: bool) -> None:
    if not robust or scenario.vehicles == 2:
        assert np.isfinite(shielded("coast", scenario, 4, 7, robust=robust)[:2]).all()


@pytest.mark.parametrize("spec", ["coast+robust:estimated", "coast+step:estimated", "e_v2x_bm:estimated"])
@pytest.mark.parametrize("script", ["coast", "e_v2x_bm"])
def test_estimated__the_script_of_the_controlled_vehicle_itself_does_not_count(spec: str, script: str) -> None:
    scripted = BASE.replace(roles={"vehicle_1": "full_brake", "vehicle_2": script, "vehicle_3": "full_brake"})
    worlds = scripted.sample(3, 1).worlds
    harms = [
        drive(worlds, make_agent(spec, scenario=scenario), scenario, 1).ledger.world_harm("total")
        for scenario in (BASE, scripted)
    ]
    np.testing.assert_array_equal(*harms)


def test_estimated__bounds_nothing_where_its_vehicle_had_an_impact_before_the_first_decision() -> None:
    late = BASE.replace(latency_s=[0.0, 1.2, 0.5])
    agents = {spec: make_agent(spec, scenario=late) for spec in ("coast+step", "coast+step:estimated")}
    harm, bound = driven(agents["coast+step:estimated"], late, 60)
    assert 0 < np.isinf(bound).sum() < 10 and (harm <= bound + ABOVE).all()
    known, received = eb.summarise(eb.evaluate(late.sample(60, 7), agents, scenario=late))
    assert known["predicted_harm"] is not None and received["predicted_harm"] is None  # no mean of what is not finite


# On the interfaces.
def told_in(env: Any, world: int = 3, action: float = 0.0) -> list[dict[str, Any]]:
    """All that a parallel shield told of an episode in which one action is proposed, in that world of list 7."""
    infos = all_infos(env, {"vehicle_2": [action]}, options={"listed_world": {"seed": 7, "number": world}})
    return [reported(each["vehicle_2"]) for each in infos]


@pytest.mark.parametrize("mode", ["step", "robust"])
@pytest.mark.parametrize("scenario", [PERIODIC, HEARD_LATE, eb.load_scenario("cooperation-2-blocked")], ids=str)
def test_parallel__does_what_the_agent_of_evaluations_does(scenario: eb.Scenario, mode: str) -> None:
    env = HybridShield(eb.parallel_env(scenario), mode=mode, estimated=True)
    for world in range(1 if mode == "robust" else 2):
        told = told_in(env, world)
        agent = make_agent(f"coast+{mode}:estimated", scenario=scenario)
        alone = drive(scenario.sample(1, 7, first=world).worlds, agent, scenario, 1)
        harm, shield = env.unwrapped.engine.ledger.world_harm("first"), alone.guarded.shield
        assert harm[0] == alone.ledger.world_harm("first")[0]
        assert sum(each["intervened"] for each in told) == shield.interventions[0]
        assert told[1]["bound_harm"] <= shield.predicted_harm[0]
        assert all(
            (each["mode"], each["trusted"], "members" in each)
            == ({"step": 1, "robust": 2}[mode], *2 * [mode == "robust"])
            for each in told
        )


def test_every_interface__decides_alike_and_says_that_the_bound_is_of_the_estimate() -> None:
    single = ShieldedEnv(eb.EthBrakeEnv(PERIODIC), estimated=True)
    aec = shielded_aec(eb.parallel_env(PERIODIC), mode="step", estimated=True)
    vector = ShieldedVectorEnv(eb.EthBrakeVectorEnv(num_envs=1, scenario=PERIODIC), estimated=True)
    start, *told = told_in(HybridShield(eb.parallel_env(PERIODIC), mode="step", estimated=True), action=0.5)
    assert start["bound_harm"] == np.inf and np.isfinite(told[0]["bound_harm"]) and set(start) == set(told[0])
    assert all(each["estimated"] and not each["trusted"] for each in told)
    for env in (single, aec, vector):
        env.reset(options={"listed_world": {"seed": 7, "number": 3}})
    for wanted in told:
        *_, info = single.step(np.array([0.5], np.float32))
        *_, infos = vector.step(np.array([[0.5]], np.float32))
        assert reported(info) == {key: column[0] for key, column in reported(infos).items()} == wanted
    decided = []
    for agent in aec.agent_iter():
        ended = aec.terminations[agent] or aec.truncations[agent]
        decided += [aec.infos[agent]["shield_applied_action"]] if agent == "vehicle_2" else []
        aec.step(np.array([0.5], np.float32) if agent == "vehicle_2" and not ended else None)
    assert decided[1:] == [each["applied_action"] for each in told]


@pytest.mark.parametrize(
    "make",
    [
        lambda: ShieldedVectorEnv(eb.EthBrakeVectorEnv(num_envs=2, scenario=PERIODIC), mode="robust", estimated=True),
        lambda: eb.ShieldedVecEnv(eb.make_sb3_vec_env(PERIODIC, 2, seed=5), mode="robust", estimated=True),
    ],
    ids=["vector", "sb3"],
)
def test_batch__rows_that_begin_again_are_those_of_a_fresh_episode(make: Any) -> None:
    """In these worlds no bound rises; what is heard of a world that is no corner may raise it."""
    env = make()
    env.reset(**({"seed": 0} if isinstance(env, ShieldedVectorEnv) else {}))
    engine, bounds, begun, rng = env.attached.engine, np.zeros(2), 0, np.random.default_rng(0)
    for _ in range(120):
        fresh, idle = engine.steps == 0, engine.ended.copy()
        env.step(rng.uniform(-1.0, 1.0, (2, 1)).astype(np.float32))
        told = env.attached.guard.tell(engine.ruling.memory, engine.ruling)["bound_harm"]
        bounds = np.where(fresh, told, bounds)
        assert (told <= bounds + ABOVE)[~idle].all()
        begun += int(fresh.sum())
    assert begun >= 4  # each row at least twice: an episode has at most 80 steps


def test_latencies_that_are_over__are_not_waited_for_again() -> None:
    late = eb.Scenario(
        name="late", vehicles=2, gaps_m=15, speeds_mps=[0, 10], braking_capacity_mps2=5, driving_capacity_mps2=5,
        mass_t=1, latency_s=[0, 0.6], roles={"vehicle_1": "full_brake", "vehicle_2": "learner"},
    )  # fmt: skip
    for found in driven(make_agent("full_brake+episode:estimated", scenario=late), late, 1):
        assert found == pytest.approx([10.0**2 - 2 * 5 * 9])  # 9 m are left when it begins to brake
