"""What the engine does is what was certified, to the last step, and what fails changes nothing."""

from __future__ import annotations

import copy
import pickle
import threading
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import Autoreset

from ethbrake_marl.agents.registry import drive, episode_engine, make_agent
from ethbrake_marl.engine import STEP, Engine
from ethbrake_marl.envs.interfaces import EthBrakeVectorEnv, parallel_env
from ethbrake_marl.envs.sb3 import make_sb3_vec_env
from ethbrake_marl.errors import InvalidInput, UncertifiedStep
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.shield import (
    HybridShield,
    MovingAtHorizon,
    ShieldedDriver,
    ShieldedEnv,
    ShieldedVectorEnv,
    StepShield,
    parse_uncertainty,
)
from ethbrake_marl.shield.sb3 import ShieldedVecEnv
from tests.shield.attacks import above_later

PAPER = load_scenario("paper-random")
DRIVE = np.array([1.0])


def shielded(scenario=PAPER, policy=None, **settings):
    env = ShieldedEnv(gymnasium.make("EthBrake-v0", scenario=scenario).unwrapped, policy, **settings)
    env.reset(seed=0)
    return env


def play(env, action=DRIVE):
    over = False
    while not over:
        *_, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    return info


def test_refused_call__one_at_the_first_decision_costs_nothing_later():
    """In 93 of 200 such episodes the harm was above the bound while the shield went on before the environment did."""
    env = HybridShield(parallel_env(), make_agent("e_v2x_bm"), mode="step")
    for seed in range(20):
        env.reset(seed=seed)
        bound, plan = env.attached.shield.first_bound[0], env.attached.shield.backup.plan
        with pytest.raises(InvalidInput, match="unknown agent 'vehicle_9'"):
            env.step({"vehicle_9": np.zeros(1)})
        assert env.attached.shield.backup.plan is plan and env.attached.shield.running.steps.tolist() == [0]
        while env.agents:
            *_, infos = env.step({"vehicle_2": DRIVE} if seed % 2 else {})
            assert infos["vehicle_2"]["shield"]["trusted"]
        assert env.unwrapped.engine.ledger.world_harm("first")[0] <= bound


class Cheating(Engine):
    """An engine in which something else happens than was predicted, in each step or in an episode's last one only."""

    what, last_only = "", False

    def _advance(self, columns):
        before = self.ended
        step = super()._advance(columns)
        rows = self.ended & ~before if self.last_only else ~before
        column = self.packed.column
        if self.what == "a step":
            self._clock[rows, STEP] += 1.0
        elif self.what == "first-impact harm":
            self._state[rows, column.harm] += 1e-12
        elif self.what == "total harm":
            self._state[rows, column.harm + column.vehicles - 1] += 1e-12
        else:
            self._state[rows, column.speed] += 1e-12
        return step


def cheat(engine, what, last_only):
    engine.__class__, engine.what, engine.last_only = Cheating, what, last_only


CHEATS = {
    "a step": "is at step 2 of its episode, certified was step 1",
    "first-impact harm": "first-impact harm of pair 1 is .* certified was",
    "total harm": "total harm of pair 1 is .* certified was",
    "speed": "speed of vehicle 1 of the line is .* certified was",
}


@pytest.mark.parametrize("what", CHEATS)
def test_step__what_is_not_certified_is_refused_and_the_worlds_stay_as_they_are(what):
    env = shielded()
    cheat(env.attached.engine, what, last_only=False)
    before, shield = env.attached.engine.worlds, env.attached.shield
    with pytest.raises(UncertifiedStep, match=CHEATS[what]):
        env.step(DRIVE)
    assert env.attached.engine.worlds.speeds_mps.tolist() == before.speeds_mps.tolist()
    assert env.attached.shield is shield and not shield.distrusted.any()


@pytest.mark.parametrize("what", [name for name in CHEATS if name != "a step"])
@pytest.mark.parametrize("interface", ["single", "vector", "sb3"])
def test_last_step__is_compared_too_whatever_starts_the_next_episode(interface, what):
    if interface == "single":
        env, actions = shielded(), DRIVE
    elif interface == "vector":
        env, actions = ShieldedVectorEnv(EthBrakeVectorEnv(3, PAPER)), np.ones((3, 1))
        env.reset(seed=0)
    else:
        env, actions = ShieldedVecEnv(make_sb3_vec_env(PAPER, 3)), np.ones((3, 1), np.float32)
        env.reset()
    cheat(env.attached.engine, what, last_only=True)
    with pytest.raises(UncertifiedStep, match=CHEATS[what]):
        for _ in range(100):
            env.step(actions)
    assert env.attached.engine.steps.max() > 20


@pytest.mark.parametrize("group", [0, 1], ids=["first-impact harm", "total harm"])
def test_ledger__harm_that_nobody_predicted_is_seen_before_the_next_decision(group):
    env = shielded()
    *_, info = env.step(DRIVE)
    assert info["shield"]["trusted"]
    engine = env.attached.engine
    engine._state[0, engine.packed.column.harm + 2 * group] += 1e-12
    *_, info = env.step(DRIVE)
    assert not info["shield"]["trusted"] and info["shield"]["reason"] == "assumption broken"


def test_past_the_shield__a_step_is_shielded_too_until_it_lets_go():
    env, engine = shielded(), None
    engine = env.attached.engine
    bound = env.attached.shield.first_bound[0]
    while not engine.ended[0]:
        env.unwrapped.step(DRIVE)
    assert engine.ledger.world_harm("first")[0] <= bound and env.attached.shield.interventions[0] > 0
    env.reset(seed=0)
    env.attached.close()
    *_, info = env.unwrapped.step(DRIVE)
    assert info["chosen_action"][0] == 1.0


def test_wrapped_in_mid_episode__needs_a_reset_first():
    plain = gymnasium.make("EthBrake-v0").unwrapped
    plain.reset(seed=0)
    env = ShieldedEnv(plain)
    with pytest.raises(UncertifiedStep, match="this episode began before the shield was put around it; reset first"):
        env.step(DRIVE)
    env.reset(seed=0)
    env.step(DRIVE)


def test_autoreset__of_gymnasium_inside_is_left_alone():
    env = ShieldedEnv(Autoreset(gymnasium.make("EthBrake-v0").unwrapped))
    env.reset(seed=0)
    for _ in range(3):
        info = play(env)
        assert info["shield"]["trusted"]
        env.step(DRIVE)  # begins the next episode
        assert env.attached.shield.running.steps.tolist() == [0]


@pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
def test_clone__between_proposal_and_step_goes_on_apart(clone):
    env = ShieldedVecEnv(make_sb3_vec_env(PAPER, 4, seed=2))
    env.reset()
    for _ in range(10):
        env.step(np.ones((4, 1), np.float32))
    env.step_async(np.ones((4, 1), np.float32))
    other = clone(env)
    assert other.attached.engine is other.venv.engine and other.attached.engine is not env.attached.engine
    told, again = ([row["shield"] for row in each.step_wait()[3]] for each in (env, other))
    assert told == again
    assert env.attached.shield.running.steps.tolist() == other.attached.shield.running.steps.tolist()


def test_reset__in_between_brings_the_proposal_to_another_episode_and_its_bound_holds():
    env = ShieldedVecEnv(make_sb3_vec_env(PAPER, 2))
    env.reset()
    env.step_async(np.ones((2, 1), np.float32))
    env.venv.reset()
    assert all(row["shield"]["trusted"] for row in env.step_wait()[3])
    assert env.attached.shield.running.steps.tolist() == env.attached.engine.steps.tolist() == [1, 1]
    with pytest.raises(InvalidInput, match="no episode is running"):
        env.step_wait()


class Refusing:
    """Another watcher, which refuses every start when it is told to."""

    refuses = False

    def begun(self, memory, alert, rows):
        if self.refuses:
            raise InvalidInput("not now")

    def stepped(self, memory, before, after):
        if self.refuses:
            raise InvalidInput("not now")


def test_refused__reset_and_step_leave_the_shield_in_its_episode():
    env, other = shielded(logging=True), Refusing()
    env.attached.engine.watch(other, None)
    for _ in range(5):
        env.step(DRIVE)
    shield, written = env.attached.shield, len(env.attached.shield.log)
    other.refuses = True
    for call in (lambda: env.reset(seed=3), lambda: env.step(DRIVE), lambda: env.step(DRIVE)):
        with pytest.raises(InvalidInput, match="not now"):
            call()
        assert env.attached.shield is shield
    other.refuses = False
    info = play(env)
    log = env.attached.shield.log
    assert info["shield"]["trusted"] and info["world_first_impact_harm"] == info["shield"]["bound_harm"]
    assert len(log) == env.attached.shield.interventions[0] > written
    assert [entry.step for entry in log] == sorted({entry.step for entry in log})


def test_step_shield__a_copy_goes_on_apart_its_log_included():
    shield = StepShield(PAPER, 1, logging=True)
    shield.begin(PAPER.sample(2, 0).worlds, np.arange(2))
    other = copy.copy(shield)
    other.decide(np.ones(2))
    assert (shield.running.steps.tolist(), other.running.steps.tolist()) == ([0, 0], [1, 1])
    assert (len(shield.log), len(other.log)) == (0, 2)
    shield.decide(np.full(2, 0.5))
    assert [entry.proposed for entry in shield.log + other.log] == [0.5, 0.5, 1.0, 1.0]


def test_snapshot__is_not_restored_under_a_shield():
    env = ShieldedVecEnv(make_sb3_vec_env(PAPER, 2))
    env.reset()
    with pytest.raises(InvalidInput, match="a shield stands in this engine"):
        env.env_method("restore", env.venv.snapshot())


def test_threads__no_episode_gets_above_its_bound():
    env = ShieldedVectorEnv(EthBrakeVectorEnv(4, PAPER, autoreset_mode="NextStep"))
    env.reset(seed=0)
    failures = []

    def work():
        for _ in range(60):
            try:
                told = env.step(np.ones((4, 1)))[4]["shield"]
                failures.extend([] if told["trusted"].all() else ["distrusted"])
            except UncertifiedStep:
                pass
            except Exception as error:
                failures.append(error)

    threads = [threading.Thread(target=work) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    shield, engine = env.attached.shield, env.attached.engine
    assert failures == [] and shield.running.steps.tolist() == engine.steps.tolist()
    assert (engine.ledger.world_harm("first") <= shield.first_bound).all()


def test_evaluation__compares_the_last_step_too():
    scenario = PAPER.replace(horizon_s=2.0)  # everything moves to the end
    worlds = scenario.sample(1, 0).worlds
    engine = episode_engine(worlds, ShieldedDriver(make_agent("full_brake"), scenario), scenario, 1)
    cheat(engine, "speed", last_only=True)
    with pytest.raises(UncertifiedStep, match=CHEATS["speed"]):
        while not engine.ended.all():
            engine.step({})
    assert engine.steps[0] > 10 and not engine.guarded.shield.running.finished.any()


class DrivesOff:
    """Brakes until it stands, and then drives."""

    name = "drives_off"

    def act(self, worlds, vehicle):
        v = worlds.vehicles
        stands = worlds.speeds_mps[:, vehicle] == 0.0
        return np.where(stands, v.driving_capacity_mps2[:, vehicle], -v.braking_capacity_mps2[:, vehicle])


def test_world__that_goes_on_after_the_shields_own_end_is_braked_fully():
    worlds = PAPER.sample(40, 7).worlds
    slower = parse_uncertainty("braking_capacity_mps2=20%").draw(worlds, np.random.default_rng(0), corners=True)
    engine = episode_engine(
        worlds, ShieldedDriver(DrivesOff(), PAPER, told=slower, uncertainty="gaps_m=0.02"), PAPER, 1
    )
    braking, after = -worlds.vehicles.braking_capacity_mps2[:, 1], np.zeros(40, bool)
    while not engine.ended.all():
        over = engine.guarded.shield.running.finished & ~engine.ended
        engine.step({})
        assert (engine.wanted_mps2[over, 1] == braking[over]).all()
        after |= over
    assert 0 < after.sum() < 40


def test_horizon__what_still_moves_then_is_told_and_warned_of_once():
    short = PAPER.replace(horizon_s=3.0)
    env = ShieldedEnv(gymnasium.make("EthBrake-v0", scenario=short).unwrapped)
    with pytest.warns(MovingAtHorizon, match="in 1 of 1 worlds something still moves at the horizon, 3 s") as told:
        env.reset(seed=0)
        env.reset(seed=1)
    assert len(told) == 1
    *_, info = env.step(DRIVE)
    assert info["shield"]["settles"] is False
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        *_, info = shielded().step(DRIVE)
    assert info["shield"]["settles"] is True


def test_horizon__settles_says_what_the_plan_comes_to_in_the_engine():
    worlds = PAPER.sample(60, 5).worlds
    scenario = PAPER.replace(horizon_s=4.2)
    shield = StepShield(scenario, 1)
    shield.begin(worlds, np.arange(60))
    episodes = drive(worlds, ShieldedDriver(make_agent("e_v2x_bm"), scenario), scenario, 1)
    rests = (episodes.final.speeds_mps == 0.0).all(axis=1)
    assert rests.tolist() == shield.settles.tolist() and 0 < rests.sum() < 60


def test_horizon__beyond_it_the_bound_says_nothing():
    now, later = above_later("coast", 200)
    assert now == 0.0 and later > 0.5


class Counting:
    """Brakes harder with every decision that it was asked for: a memory that a refused call must not move."""

    name = "counting"

    def begin(self, alert, vehicle, scripts):
        return np.zeros(alert.n)

    def act(self, worlds, memory, vehicle):
        memory += 1.0
        return -np.minimum(0.3 * memory, 7.0), memory


@pytest.mark.filterwarnings("ignore::ethbrake_marl.shield.MovingAtHorizon")
def test_episode_mode__a_refused_call_does_not_ask_the_policy_again():
    harms = []
    for refused in (0, 3):
        env = HybridShield(parallel_env(), Counting())
        env.reset(seed=4)
        while env.agents:
            for _ in range(refused):
                with pytest.raises(InvalidInput, match="unknown agent"):
                    env.step({"vehicle_9": np.zeros(1)})
            *_, infos = env.step({})
        harms.append(infos["vehicle_2"]["world_first_impact_harm"])
    assert harms[0] == harms[1]
    env.reset(seed=4)
    *_, infos = env.unwrapped.step({"vehicle_2": np.zeros(1)})
    assert infos["vehicle_2"]["chosen_action"] == np.float32(env.attached.infos()[0]["chosen_action"]) < 0.0
