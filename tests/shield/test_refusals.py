"""What shields refuse: options, uncertainties, environments that they do not go around, and use out of order."""

from collections.abc import Callable
from functools import cache

import gymnasium
import numpy as np
import pytest
from pettingzoo.utils import BaseParallelWrapper, BaseWrapper
from stable_baselines3.common.vec_env import VecMonitor

import ethbrake_marl as eb
from ethbrake_marl.agents.driving import drive
from ethbrake_marl.agents.making import make_agent
from ethbrake_marl.agents.protocol import Team
from ethbrake_marl.envs.gymnasium import EthBrakeEnv
from ethbrake_marl.envs.pettingzoo import env as aec_env, parallel_env
from ethbrake_marl.envs.sb3 import make_sb3_vec_env
from ethbrake_marl.envs.vector import EthBrakeVectorEnv
from ethbrake_marl.errors import UncertifiedStep, UnknownName
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.shields.certify import certify, plan_harm
from ethbrake_marl.shields.drivers import ShieldedDriver
from ethbrake_marl.shields.evidence import review
from ethbrake_marl.shields.options import ShieldOptions
from ethbrake_marl.shields.paper_hybrid import HybridAgent
from ethbrake_marl.shields.sb3 import ShieldedVecEnv
from ethbrake_marl.shields.step import StepShield
from ethbrake_marl.shields.wrappers import HybridShield, ShieldedEnv, ShieldedVectorEnv, shielded_aec
from tests.fixtures.lines import line as one_line
from tests.refused import refused
from tests.shield.attacks import begun

PAPER, PAIR = load_scenario("paper-random"), load_scenario("cooperation-3-pair")
WORLDS = PAPER.sample(5, 3).worlds
BRAKE, COAST = make_agent("full_brake"), make_agent("coast")
PERIODIC = load_scenario("cooperation-2-paper").replace(v2x={"preset": "blocked", "persistence": "periodic"})
WORLD = one_line([10.0, 8.0], [20.0, 18.0, 39.9], [8, 6, 5], [0, 0.4, 0.7], driving=2.0, mass=[1, 2, 4])


@cache
def started() -> StepShield:
    """A shield of Vehicle 2 in five episodes."""
    return begun(PAPER, WORLDS)


@cache
def team() -> StepShield:
    """A shield of two vehicles in one episode."""
    return begun(PAIR, PAIR.sample(1, 3).worlds)


STEP_SHIELD: dict[str, Callable[[], object]] = {
    "shield: vehicle = 9: must be an index from 0 to 2": lambda: StepShield(PAPER, 9),
    "shield: allowance = -1.0: must be a finite number of at least 0 m2/": lambda: StepShield(PAPER, 1, allowance=-1.0),
    "shield: decide() was called before any episode began; call begin first": lambda: StepShield(PAPER, 1).decide(
        np.zeros(3)
    ),
    "shield: proposed has the shape (3,); must have the shape (5,)": lambda: started().decide(np.zeros(3)),
    "shield: begin was called for row 7, but the shield has only 5 rows (worlds); to add rows, call begin": lambda: (
        started().begin(WORLDS.take([0, 1]), np.array([3, 7]))
    ),
    "certify: the shapes of proposed, backup.harm and budget are (2,), (5,) and (5,); must be (5,), (5,) and": lambda: (
        certify(started().memory.running, np.zeros(2), started().memory.backup, started().bound)
    ),
    "certify: in every world, budget must be at least backup.harm (the harm of": lambda: certify(
        started().memory.running, np.zeros(5), started().memory.backup, started().bound - 1.0
    ),
    "shield: plan has the shape (5, 3); must have the shape (5, at least": lambda: plan_harm(
        started().memory.running, np.zeros((5, 3))
    ),
    "certify: the shapes of proposed, backup.harm and budget are (1,), (1,) and (1,); must be (1, 2), (1,)": lambda: (
        certify(team().memory.running, np.zeros(1), team().memory.backup, team().bound)
    ),
    "shield: plan has the shape (1, 81); must have the shape (1, at least 75,": lambda: plan_harm(
        team().memory.running, np.zeros((1, 81))
    ),
    "shield: vehicle = (2, 1): must be different indices in increasing order": lambda: StepShield(PAIR, (2, 1)),
    "shield: vehicle = (): must be an index from 0 to 2": lambda: StepShield(PAIR, ()),
    "shield: cap = 'baseline': must be None for a shield that considers several possible": lambda: StepShield(
        PAPER, 1, cap="baseline"
    ).begin(WORLDS.take([0]), np.arange(1), BRAKE, possible=WORLDS),
    "shield: policy has a policy for the vehicle indices [1]; must have one for each shielded vehicle, [1,": lambda: (
        StepShield(PAIR, (1, 2)).begin(PAIR.sample(1, 0).worlds, np.arange(1), COAST)
    ),
    "shield: assumed has 2 worlds, but the environment has a row 4; assumed must have one world for": lambda: drive(
        WORLDS, ShieldedDriver(COAST, PAPER, assumed=WORLDS.take([0, 1])), PAPER, 1
    ),
    "review: the shield has no log; make the shield with logging=True, and run episodes": lambda: review(
        drive(WORLDS, ShieldedDriver(COAST, PAPER), PAPER, 1).guarded.shield, COAST, WORLDS
    ),
    "review: worlds has 5 worlds; pass the worlds of the shield's last episodes, 1 world": lambda: review(
        drive(WORLDS.take([0]), ShieldedDriver(COAST, PAPER, logging=True), PAPER, 1).guarded.shield, COAST, WORLDS
    ),
}


@pytest.mark.parametrize("message", STEP_SHIELD)
def test_step_shield__refuses(message: str) -> None:
    with refused(message):
        STEP_SHIELD[message]()


AGENTS: dict[str, Callable[[], object]] = {
    "must be a Scenario; eb.load_scenario(name) loads one": lambda: ShieldedDriver(COAST, "paper-random"),
    "step: assumed = 3: must be None or a Worlds object (the worlds at the alert)": lambda: ShieldedDriver(
        COAST, PAPER, assumed=3
    ),
    "shield: mode = 'episode': is not possible with ShieldedDriver; use HybridAgent": lambda: ShieldedDriver(
        COAST, PAPER, mode="episode"
    ),
    "agent 'coast+step' drives vehicle_2, but vehicle_3 of scenario 'cooperation-3-pair'": lambda: drive(
        PAIR.sample(1, 0).worlds, ShieldedDriver(COAST, PAIR), PAIR, 1
    ),
    "team 'half': does not drive vehicle_3; behind a shield, a team must drive every learner": lambda: ShieldedDriver(
        Team({1: COAST}, "half"), PAIR
    ),
    "e_v2x_bm: mode = 'couple': must be 'coupled' or 'pairwise'": lambda: HybridAgent(BRAKE, PAPER, bound="couple"),
    "harm_count = 'both': must be 'first' or 'total'": lambda: HybridAgent(BRAKE, PAPER, harm_count="both"),
    "shield: to shield the agent 'coast', pass scenario=... (the scenario in which it drives), and leave out": lambda: (
        eb.shield(COAST)
    ),
    "shield: agent 'coast+step' already has a shield": lambda: eb.shield(
        make_agent("coast+step", scenario=PAPER), scenario=PAPER
    ),
}


@pytest.mark.parametrize("message", AGENTS)
def test_agent_behind_a_shield__is_refused(message: str) -> None:
    with refused(message):
        AGENTS[message]()


OPTIONS: dict[str, Callable[[], object]] = {
    "shield: cap = 'baseline': cap is possible only in mode step": lambda: ShieldOptions(
        mode="episode", cap="baseline"
    ),
    "shield: bound = 'pairwise': not a setting of mode step; use mode episode": lambda: ShieldOptions(
        mode="step", bound="pairwise"
    ),
    "shield: cap = 'mine': must be baseline or None": lambda: ShieldOptions(cap="mine"),
    "shield: intervention_penalty = -1.0: must be a finite number of at least 0": lambda: ShieldOptions(
        intervention_penalty=-1.0
    ),
    "shield: intervention_penalty = nan: must be a finite number of at least 0": lambda: ShieldOptions(
        intervention_penalty=float("nan")
    ),
}


@pytest.mark.parametrize("message", OPTIONS)
def test_options__are_refused(message: str) -> None:
    with refused(message):
        OPTIONS[message]()


AROUND: dict[str, Callable[[], object]] = {
    "ShieldedVecEnv: bound = 'pairwise': not a setting of mode step; use mode episode": lambda: ShieldedVecEnv(
        make_sb3_vec_env(PAPER, 2), mode="step", bound="pairwise"
    ),
    "HybridShield: None: must be an environment made by eb.parallel_env; eb.shield(env) chooses the": lambda: (
        HybridShield(None, BRAKE)
    ),
    "must be an environment made by gymnasium.make('EthBrake-v1')": lambda: ShieldedEnv(gymnasium.make("CartPole-v1")),
    "policy = 'ppo': must be an agent or a policy (eb.load_policy); eb.policy_agent(function) makes": lambda: (
        HybridShield(parallel_env(), "ppo")
    ),
    "HybridShield: agents = 5: must be a list of vehicle names": lambda: HybridShield(parallel_env(), BRAKE, agents=5),
    "HybridShield: agents = ('vehicle_1',): must be all learners, ('vehicle_2',), because the bound is": lambda: (
        HybridShield(parallel_env(), BRAKE, agents=["vehicle_1"])
    ),
    "HybridShield: policy must have one policy for each of vehicle_2, vehicle_3, and for no other vehicle": lambda: (
        HybridShield(parallel_env(PAIR), {"vehicle_2": COAST}, mode="step")
    ),
    "scenario 'cooperation-3-pair' has 2 learners (vehicle_2, vehicle_3); HybridShield needs exactly one": lambda: (
        HybridShield(parallel_env(PAIR), COAST, mode="episode")
    ),
    "no vehicle of scenario 'paper-random' learns, and only learners can be shielded; make": lambda: HybridShield(
        parallel_env(learners=[]), BRAKE, mode="step"
    ),
    "HybridShield: ethbrake_v1: must be an environment made by eb.parallel_env; eb.shield(env) chooses": lambda: (
        HybridShield(aec_env(), mode="step")
    ),
    "shield: in BaseWrapper<ethbrake_v1> the agents act one after the other; make a shielded": lambda: eb.shield(
        BaseWrapper(aec_env())
    ),
    "shield: None: must be an agent, a team, or an environment made by eb.parallel_env, eb.env": lambda: eb.shield(
        None
    ),
}


@pytest.mark.parametrize("message", AROUND)
def test_environment__is_refused(message: str) -> None:
    with refused(message):
        AROUND[message]()


NAMES: dict[str, Callable[[], object]] = {
    "unknown shield cap 'mine'": lambda: StepShield(PAIR, (1, 2), cap="mine"),
    "unknown HybridShield option 'allowence'; did you mean 'allowance'?": lambda: HybridShield(
        parallel_env(), allowence=1.0
    ),
}


@pytest.mark.parametrize("message", NAMES)
def test_name__is_unknown(message: str) -> None:
    with refused(message, UnknownName):
        NAMES[message]()


ALREADY: dict[str, Callable[[], object]] = {
    "HybridShield": lambda: HybridShield(HybridShield(parallel_env(), mode="step").unwrapped),
    "HybridShield in a wrapper": lambda: shielded_aec(BaseParallelWrapper(HybridShield(parallel_env()))),
    "agents in turn": lambda: shielded_aec(shielded_aec(parallel_env())),
    "agents in turn in a wrapper": lambda: HybridShield(BaseWrapper(shielded_aec(parallel_env()))),
    "ShieldedEnv": lambda: ShieldedEnv(gymnasium.wrappers.RecordEpisodeStatistics(ShieldedEnv(EthBrakeEnv()))),
    "ShieldedVectorEnv": lambda: ShieldedVectorEnv(
        gymnasium.wrappers.vector.RecordEpisodeStatistics(ShieldedVectorEnv(EthBrakeVectorEnv(2)))
    ),
    "ShieldedVecEnv": lambda: ShieldedVecEnv(VecMonitor(ShieldedVecEnv(make_sb3_vec_env(PAPER, 2)))),
}


@pytest.mark.parametrize("interface", ALREADY)
def test_second_shield__is_refused_because_a_bound_holds_for_one_alone(interface: str) -> None:
    with refused("(mode step), and can have only one; close() that shield before you add another"):
        ALREADY[interface]()


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (
            {},
            "shield: the action of a vehicle is missing, and the shield has no policy that could propose it; pass the",
        ),
        ([0.0], "step: actions = [0.0]: must be a mapping from agent to action, such as {'vehicle_2': [-1.0]}"),
        ({"vehicle_2": np.array([np.nan])}, "action of vehicle_2 = nan: must be from -1 (full braking) to 1 (full"),
        ({"vehicle_2": np.array([1.5])}, "action of vehicle_2 = 1.5: must be from -1 (full braking) to 1 (full"),
        ({"vehicle_2": np.array([1j])}, "action of vehicle_2: array([0.+1.j]) is not a number"),
    ],
    ids=["none", "no mapping", "nan", "beyond 1", "complex"],
)
def test_action__is_refused(actions: object, message: str) -> None:
    env = HybridShield(parallel_env(), mode="step")
    env.reset(seed=1)
    with refused(message):
        env.step(actions)


def test_action__of_agents_in_turn_is_refused() -> None:
    env = shielded_aec(parallel_env(), mode="step")
    env.reset(seed=7)
    env.step(None)
    with refused("action of vehicle_2 = 3.0: must be from -1 (full braking) to 1 (full driving)"):
        env.step([3.0])


def test_actions__of_many_environments_are_refused() -> None:
    env = ShieldedVectorEnv(EthBrakeVectorEnv(2))
    env.reset(seed=3)
    with refused("action of the learners: array([[0.+1.j],"):
        env.step(np.full((2, 1), 1j))


def test_closed_shield__is_refused_and_cannot_be_used() -> None:
    env = ShieldedEnv(EthBrakeEnv())
    env.close()
    with refused("ShieldedEnv: <ShieldedEnv<EthBrakeEnv instance>> is a shield that was closed"):
        eb.shield(env)
    many = ShieldedVecEnv(make_sb3_vec_env(PAPER, 2))
    many.close()
    with refused("ShieldedVecEnv: this shield was closed; put a new shield around the environment"):
        many.reset()


def test_snapshot__is_restored_before_the_shield_is_put_around() -> None:
    env = ShieldedVecEnv(make_sb3_vec_env(PAPER, 2))
    env.reset()
    with refused("engine snapshot: this engine has a shield, whose memory a snapshot does not contain"):
        env.env_method("restore", env.venv.snapshot())


def test_step_wait__needs_a_step() -> None:
    env = ShieldedVecEnv(make_sb3_vec_env(PAPER, 2))
    env.reset()
    env.step_async(np.ones((2, 1)))
    env.step_wait()
    with refused("step: no episode is running; call reset first"):
        env.step_wait()


def test_episode_that_began_before_the_shield__is_not_certified() -> None:
    plain = EthBrakeEnv()
    plain.reset(seed=3)
    with refused("shield: this episode began before the shield was added; call reset first", UncertifiedStep):
        ShieldedEnv(plain).step([1.0])


class Fresh(gymnasium.Wrapper):
    """Makes another environment at the second reset."""

    def reset(self, **options):
        if self.env.unwrapped.engine.ruling is not None:
            self.env = EthBrakeEnv("paper-random")
        return self.env.reset(**options)


def test_environment_that_was_exchanged_inside__is_noticed() -> None:
    shielded = eb.shield(Fresh(EthBrakeEnv("paper-random")))
    shielded.reset(seed=7)
    shielded.step([1.0])
    with refused("ShieldedEnv: the environment inside this wrapper was replaced"):
        shielded.reset(seed=8)
