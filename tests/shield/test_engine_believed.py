"""``believed=True`` on every interface: the shield of ``+step:believed`` and ``+robust:believed`` around a learner."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from pettingzoo.test import parallel_api_test

import ethbrake_marl as eb
from ethbrake_marl.agents.registry import drive, make_agent
from ethbrake_marl.envs.interfaces import EthBrakeEnv, EthBrakeVectorEnv, parallel_env
from ethbrake_marl.envs.sb3 import make_sb3_vec_env
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.scenario import Scenario, load_scenario
from ethbrake_marl.shield import HybridShield, ShieldedEnv, ShieldedVectorEnv, shielded_aec
from ethbrake_marl.shield.sb3 import ShieldedVecEnv
from tests.shield.attacks import ABOVE, HEARD_LATE, LISTS, NEVER_HEARD
from tests.shield.test_interfaces import KEYS

PERIODIC = load_scenario("cooperation-2-paper").replace(v2x={"preset": "blocked", "persistence": "periodic"})


def harm_of(env: Any) -> float:
    return float(env.unwrapped.engine.ledger.world_harm("first")[0])


def driven(env: Any, world: int, action: float = 0.0) -> list[dict[str, Any]]:
    """All that a parallel shield told of an episode in which one action is proposed, in that world of list 7."""
    _, infos = env.reset(options={"listed_world": {"seed": 7, "number": world}})
    told = [infos["vehicle_2"]["shield"]]
    while env.agents:
        *_, infos = env.step({"vehicle_2": np.array([action])})
        told.append(infos["vehicle_2"]["shield"])
    return told


@pytest.mark.parametrize("mode", ["step", "robust"])
@pytest.mark.parametrize("scenario", [PERIODIC, HEARD_LATE, "cooperation-2-blocked"], ids=str)
def test_parallel__does_what_the_agent_of_evaluations_does(scenario: Scenario | str, mode: str) -> None:
    scenario = load_scenario(scenario) if isinstance(scenario, str) else scenario
    env = HybridShield(parallel_env(scenario), mode=mode, believed=True)
    for world in range(1 if mode == "robust" else 2):
        told = driven(env, world)
        agent = make_agent(f"coast+{mode}:believed", scenario=scenario)
        alone = drive(scenario.sample(1, 7, first=world).worlds, agent, scenario, 1)
        assert harm_of(env) == alone.ledger.world_harm("first")[0]
        assert sum(each["intervened"] for each in told) == alone.guarded.shield.interventions[0]
        assert told[1]["bound_harm"] <= alone.guarded.shield.predicted_harm[0]


@pytest.mark.parametrize("scenario", LISTS.values(), ids=list(LISTS))
def test_robust__at_the_corners_no_world_is_above_the_first_bound_that_was_told(scenario: Scenario) -> None:
    env = HybridShield(parallel_env(scenario), mode="robust", believed=True)
    for seed in range(3):
        told = driven(env, seed, 1.0)
        assert harm_of(env) <= told[1]["bound_harm"] + ABOVE


def test_infos__say_that_the_bound_is_of_the_belief() -> None:
    for mode, trusted in (("step", False), ("robust", True)):
        told = driven(HybridShield(parallel_env(PERIODIC), mode=mode, believed=True), 3)
        assert all(each["believed"] and each["trusted"] is trusted and each["mode"] == mode for each in told)
        assert told[0]["bound_harm"] == np.inf and np.isfinite(told[1]["bound_harm"])
        assert set(told[0]) == set(told[1]) == KEYS | {"believed"} | ({"members"} if mode == "robust" else set())
    assert "believed" not in driven(HybridShield(parallel_env(PERIODIC), mode="step"), 3)[1]


def test_step__in_the_middle_is_above_its_bound_where_the_world_is_not_the_middle() -> None:
    env = HybridShield(parallel_env(NEVER_HEARD), mode="step", believed=True)
    first = [(driven(env, seed)[1]["bound_harm"], harm_of(env)) for seed in range(12)]
    assert any(harm > bound + 1.0 for bound, harm in first)


@pytest.mark.slow
def test_interior__bounds_every_world_of_the_ranges() -> None:
    inside = NEVER_HEARD.replace(
        gaps_m=[{"uniform": [5.13, 9.71]}, {"uniform": [7.37, 7.58]}], mass_t=[4.5, 5.5, {"uniform": [4.0, 5.0]}],
        speeds_mps=[20.0, 20.0, {"uniform": [19.0, 19.5]}],
    )  # fmt: skip
    env = HybridShield(parallel_env(inside), mode="robust", robust="interior", believed=True)
    for seed in range(2):
        told = driven(env, seed)
        assert harm_of(env) <= told[1]["bound_harm"] + ABOVE


def test_every_interface__decides_alike() -> None:
    start = {"options": {"listed_world": {"seed": 7, "number": 3}}}
    single = ShieldedEnv(EthBrakeEnv(PERIODIC), believed=True)
    aec = shielded_aec(parallel_env(PERIODIC), mode="step", believed=True)
    vector = ShieldedVectorEnv(EthBrakeVectorEnv(num_envs=1, scenario=PERIODIC), believed=True)
    told = driven(HybridShield(parallel_env(PERIODIC), mode="step", believed=True), 3, 0.5)
    for env in (single, aec, vector):
        env.reset(**start)
    for wanted in told[1:]:
        *_, info = single.step(np.array([0.5], np.float32))
        assert info["shield"] == wanted
        *_, infos = vector.step(np.array([[0.5]], np.float32))
        assert {key: infos["shield"][key][0] for key in wanted} == wanted
    decided = [0.0]
    for agent in aec.agent_iter():
        ended = aec.terminations[agent] or aec.truncations[agent]
        if agent == "vehicle_2":
            decided.append(aec.infos[agent]["shield"]["chosen_action"])
        aec.step(np.array([0.5], np.float32) if agent == "vehicle_2" and not ended else None)
    assert decided[2:] == [each["chosen_action"] for each in told[1:]]
    venv = ShieldedVecEnv(make_sb3_vec_env(PERIODIC, 3, seed=7), believed=True)
    venv.reset()
    for _ in range(40):
        *_, infos = venv.step(np.full((3, 1), 1.0))
    assert all(info["shield"]["believed"] for info in infos)


def test_vector__rows_that_begin_again_are_those_of_a_fresh_episode() -> None:
    env = ShieldedVectorEnv(EthBrakeVectorEnv(num_envs=2, scenario=PERIODIC), mode="robust", believed=True)
    env.reset(seed=5)
    rng, first, bounds = np.random.default_rng(0), np.ones(2, bool), np.zeros(2)
    ended = 0
    for _ in range(120):
        _, _, terminated, truncated, infos = env.step(rng.uniform(-1.0, 1.0, (2, 1)).astype(np.float32))
        told, running = infos["shield"]["bound_harm"], infos["_shield"]
        bounds = np.where(first & running, told, bounds)
        assert (told[running] <= bounds[running] + ABOVE).all()
        first = np.where(running, terminated | truncated, first)
        ended += int((terminated | truncated).sum())
    assert ended >= 3


def test_refused__calls_leave_the_shield_as_it_was() -> None:
    envs = [HybridShield(parallel_env(PERIODIC), mode="step", believed=True) for _ in range(2)]
    for env in envs:
        env.reset(seed=2)
    while envs[0].agents:
        with pytest.raises(InvalidInput):
            envs[0].step({"vehicle_2": np.array([np.nan, 1.0])})
        attached = envs[0].attached
        attached.guard.decide(attached.engine, attached.memory, np.array([[-1.0]]))  # certified, and never carried out
        told = [env.step({"vehicle_2": np.array([0.7])})[4]["vehicle_2"]["shield"] for env in envs]
        assert told[0] == told[1]


def test_step_past_the_shield__is_shielded_too() -> None:
    inner = parallel_env(PERIODIC)
    env = HybridShield(inner, mode="step", believed=True)
    env.reset(seed=1)
    *_, infos = inner.step({"vehicle_2": np.array([1.0])})
    told = env.attached.infos()[0]
    assert told["intervened"] and infos["vehicle_2"]["chosen_action"][0] == np.float32(told["chosen_action"]) < 0.0


def test_policy__proposes_where_nobody_does() -> None:
    policy = make_agent("ppo@shipped/ppo", scenario=PERIODIC)
    env = HybridShield(parallel_env(PERIODIC), policy, mode="step", believed=True)
    env.reset(seed=1)
    assert -1.0 <= env.step({})[4]["vehicle_2"]["shield"]["proposed_action"] <= 1.0
    alone = HybridShield(parallel_env(PERIODIC), mode="step", believed=True)
    alone.reset(seed=1)
    with pytest.raises(InvalidInput, match="no action was given"):
        alone.step({})


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_checkers__of_the_libraries_pass() -> None:
    parallel_api_test(HybridShield(parallel_env(PERIODIC), mode="step", believed=True), num_cycles=60)
    gymnasium.utils.env_checker.check_env(ShieldedEnv(EthBrakeEnv(PERIODIC), believed=True), skip_render_check=True)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({}, "mode episode takes none"),
        ({"mode": "step", "allowance": 1.0}, "allowance = 1.0: not together with believed"),
        ({"mode": "step", "cap": "baseline"}, "cap = 'baseline': not together with believed"),
        ({"mode": "step", "logging": True}, "logging = True: not together with believed"),
        ({"mode": "robust", "uncertainty": "gaps_m=0.5"}, "uncertainty = .*: not together with believed"),
        ({"mode": "step", "robust": "interior"}, "mode step takes none"),
        ({"mode": "step", "believed": "yes"}, "must be True or False"),
    ],
)
def test_options__that_do_not_fit_are_refused(options: dict[str, Any], words: str) -> None:
    with pytest.raises(InvalidInput, match=words):
        HybridShield(parallel_env(PERIODIC), **{"believed": True, **options})


def test_several_learners_and_mixtures__are_refused() -> None:
    with pytest.raises(InvalidInput, match="shields one learner, not several"):
        HybridShield(parallel_env("cooperation-3-pair"), mode="step", believed=True)
    members = [{"scenario": load_scenario(name).declared()} for name in ("paper-random", "paper-random-brake-only")]
    with pytest.raises(InvalidInput, match="is a mixture"):
        eb.ShieldedEnv(eb.EthBrakeEnv(Scenario(name="mixed", mixture=members)), believed=True)
