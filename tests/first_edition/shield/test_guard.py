"""The guard in the engine: what it does is what was certified, to the last step, and what fails changes nothing."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import InvalidInput, UncertifiedStep
from ethbrake_marl.first_edition.agents.driving import drive, episode_engine
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.engine.compiled_step import STEP
from ethbrake_marl.first_edition.engine.engine import Engine
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver
from ethbrake_marl.first_edition.shields.guard import MovingAtHorizon
from ethbrake_marl.first_edition.shields.paper_hybrid import HybridAgent
from ethbrake_marl.first_edition.shields.wrappers import HybridShield, ShieldedEnv, ShieldedVectorEnv
from tests.first_edition.rest.fixture_asked import Acts, Asked
from tests.first_edition.shield.plays import reported

PAPER = eb.load_scenario("paper-random")
WORLDS = PAPER.sample(300, 3).worlds
DRIVE = np.array([1.0])


def shielded(scenario=PAPER, policy=None, **settings):
    env = ShieldedEnv(gymnasium.make("EthBrake-v1", scenario=scenario).unwrapped, policy, **settings)
    env.reset(seed=0)
    return env


STATE = {  # columns in which something else happens
    "first-impact harm": lambda column: column.harm,
    "total harm": lambda column: column.harm + column.vehicles - 1,
    "speed": lambda column: column.speed,
}


class Cheating(Engine):
    """An engine in which something else happens than was predicted, in each step or in an episode's last one only."""

    what, last_only = "", False

    def _advance(self, columns):
        before = self.ended
        step = super()._advance(columns)
        rows = self.ended & ~before if self.last_only else ~before
        if self.what == "a step":
            self.state.clock[rows, STEP] += 1.0
        else:
            self.state.motion[rows, STATE[self.what](self.packed.column)] += 1e-12
        return step


def cheat(engine, what, last_only):
    engine.__class__, engine.what, engine.last_only = Cheating, what, last_only


CHEATS = {
    "a step": "is at step 2 of its episode, but the shield predicted step 1",
    "first-impact harm": "first-impact harm of pair 1 is .* but the shield predicted",
    "total harm": "total harm of pair 1 is .* but the shield predicted",
    "speed": "speed of vehicle 1 of the line is .* but the shield predicted",
}


@pytest.mark.parametrize("what", CHEATS)
def test_step__what_is_not_certified_is_refused_and_the_worlds_stay_as_they_are(what):
    env = shielded()
    cheat(env.attached.engine, what, last_only=False)
    before, shield = env.attached.engine.worlds, env.attached.shield
    with pytest.raises(UncertifiedStep, match=CHEATS[what]):
        env.step(DRIVE)
    assert env.attached.engine.worlds.speeds_mps.tolist() == before.speeds_mps.tolist()
    assert env.attached.shield is shield and not shield.memory.distrusted.any()


@pytest.mark.parametrize("what", STATE)
@pytest.mark.parametrize("interface", ["single", "vector", "sb3", "evaluation"])
def test_last_step__is_compared_too_whatever_starts_the_next_episode(interface, what):
    actions = np.ones((3, 1), np.float32)
    if interface == "evaluation":
        short = PAPER.replace(horizon_s=4.0)  # everything moves to the end
        driver = ShieldedDriver(make_agent("full_brake"), short)
        engine, step = episode_engine(short.sample(1, 0).worlds, driver, short, 1), None
    else:
        env = {
            "single": lambda: ShieldedEnv(gymnasium.make("EthBrake-v1").unwrapped),
            "vector": lambda: ShieldedVectorEnv(eb.EthBrakeVectorEnv(3, PAPER)),
            "sb3": lambda: eb.ShieldedVecEnv(eb.make_sb3_vec_env(PAPER, 3)),
        }[interface]()
        env.reset()
        engine, step = env.attached.engine, lambda: env.step(DRIVE if interface == "single" else actions)
    cheat(engine, what, last_only=True)
    with pytest.raises(UncertifiedStep, match=CHEATS[what]):
        for _ in range(100):
            engine.step({}) if step is None else step()
    assert engine.steps.max() > 20


@pytest.mark.parametrize("group", [0, 1], ids=["first-impact harm", "total harm"])
def test_ledger__harm_that_nobody_predicted_is_seen_before_the_next_decision(group):
    env = shielded()
    *_, info = env.step(DRIVE)
    assert info["shield_trusted"]
    engine = env.attached.engine
    engine.packed.state[0, engine.packed.column.harm + 2 * group] += 1e-12
    *_, info = env.step(DRIVE)
    assert not info["shield_trusted"] and info["shield_reason"] == eb.ShieldReason.ASSUMPTION_BROKEN


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
def test_clone__between_proposal_and_step_goes_on_apart(clone):
    env = eb.ShieldedVecEnv(eb.make_sb3_vec_env(PAPER, 4, seed=2))
    env.reset()
    env.step(np.ones((4, 1), np.float32))
    env.step_async(np.ones((4, 1), np.float32))
    other = clone(env)
    assert other.attached.engine is other.venv.engine and other.attached.engine is not env.attached.engine
    told, again = ([reported(row) for row in each.step_wait()[3]] for each in (env, other))
    assert told == again and "bound_harm" in told[0]
    assert env.attached.shield.memory.running.steps.tolist() == other.attached.shield.memory.running.steps.tolist()


@Acts
def drives_off(worlds, vehicle):
    """Brakes until it stands, and then drives."""
    v, stands = worlds.vehicles, worlds.speeds_mps[:, vehicle] == 0.0
    return np.where(stands, v.driving_capacity_mps2[:, vehicle], -v.braking_capacity_mps2[:, vehicle])


def test_horizon__what_still_moves_then_is_told_and_warned_of_once():
    env = ShieldedEnv(gymnasium.make("EthBrake-v1", scenario=PAPER.replace(horizon_s=3.0)).unwrapped)
    with pytest.warns(MovingAtHorizon, match="in 1 of 1 worlds a vehicle still moves at the horizon .3 s.") as told:
        env.reset(seed=0)
        env.reset(seed=1)
    assert len(told) == 1
    assert [each.step(DRIVE)[-1]["shield_settles"] for each in (env, shielded())] == [False, True]


# Mode episode: never worse than its baseline, in any world, and as predicted.


def harm(agent, harm_count="first", worlds=WORLDS):
    return drive(worlds, agent, PAPER, 1).ledger.world_harm(harm_count)


@Acts
def late_brake(worlds, vehicle):
    """Coasts until 0.9 s, then brakes fully: no constant deceleration, so sometimes better than any."""
    return np.where(worlds.time_s < 0.9, 0.0, -worlds.vehicles.braking_capacity_mps2[:, vehicle])


def memory_of(agent):
    return Asked(agent).begin(WORLDS, 1).memory


@pytest.mark.parametrize("harm_count", ["first", "total"])
def test_episode__is_never_worse_than_either_part(harm_count):
    hybrid = HybridAgent(late_brake, PAPER, harm_count=harm_count)
    realised, memory = harm(hybrid, harm_count), memory_of(hybrid)
    alone, baseline = harm(late_brake, harm_count), harm(make_agent("e_v2x_bm", harm_count=harm_count), harm_count)
    assert (realised <= np.minimum(alone, baseline)).all() and realised.tolist() == memory["predicted_harm"].tolist()
    assert memory["chosen_policy"].tolist() == (alone <= baseline).tolist()
    assert 0 < memory["chosen_policy"].sum() < WORLDS.n


def test_episode__the_pairwise_bound_is_exceeded_in_the_same_physics():
    hybrid = HybridAgent(make_agent("constant:0.5"), PAPER, bound="pairwise")
    assert (harm(hybrid) > memory_of(hybrid)["bound_harm"] + 1.0).mean() > 0.3


def test_episode__applies_the_certified_strategy_whatever_is_proposed():
    shielded = HybridShield(eb.parallel_env(), make_agent("full_brake"), mode="episode")
    for seed in range(6):
        shielded.reset(seed=seed)
        while shielded.agents:
            _, _, _, _, infos = shielded.step({"vehicle_2": np.array([1.0])})
            told = reported(infos["vehicle_2"])
            assert told["proposed_action"] == 1.0 and told["applied_action"] <= 0.0
            assert infos["vehicle_2"]["chosen_action"] == pytest.approx(told["applied_action"], abs=1e-12)
        realised = shielded.unwrapped.engine.ledger.world_harm("first")[0]
        assert realised == pytest.approx(min(told["policy_harm"], told["bound_harm"]), abs=1e-9)


class Counting:
    """Brakes harder with every decision that it was asked for: a memory that it writes into."""

    name = "counting"

    def begin(self, alert, vehicle, scripts):
        return {"steps": np.zeros(alert.n)}

    def act(self, worlds, memory, vehicle):
        memory["steps"] += 1.0
        return -np.minimum(0.3 * memory["steps"], 7.0), memory


def remembering(observation, state):
    state += 1.0  # a memory that no decision which is not carried out must move
    return -np.minimum(state - 1.0, 10.0) / 10.0, state


@pytest.mark.parametrize("policy", [eb.policy_agent(remembering, initial_state=lambda n: np.zeros((n, 1))), Counting()])
@pytest.mark.parametrize("settings", [{"mode": "episode"}, {"mode": "step"}], ids=str)
def test_policy_with_a_memory__is_asked_once_per_decision_whoever_proposes(settings, policy):
    asks_once(settings, policy)


def asks_once(settings, policy):
    def asked():
        memory = attached.memory.shield["policy"] if settings["mode"] == "episode" else attached.memory.policies[1]
        return memory["steps"].tolist()

    env = HybridShield(eb.parallel_env(), policy, **settings)
    env.reset(seed=7)
    attached = env.attached
    assert asked() == [0]
    for k, actions in enumerate(({"vehicle_2": [-0.3]}, {}, {"vehicle_2": [-0.9]}, {"vehicle_2": [1.0]}, {})):
        nothing = np.full((1, 1), np.nan)
        told = [attached.guard.decide(attached.engine, attached.memory, nothing).proposed for _ in range(2)]
        assert np.array_equal(*told, equal_nan=True)
        with pytest.raises(InvalidInput):
            env.step({"vehicle_2": [-0.3], "vehicle_9": [0.0]})
        env.step(actions)
        assert asked() == [k + 1]
        assert settings != {"mode": "step"} or attached.shield.memory.running.steps.tolist() == [k + 1]
