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
    "shield: allowance = -1.0: must be a number, at least 0 m2/s2": lambda: StepShield(PAPER, 1, allowance=-1.0),
    "shield: decide, but no episode has begun; call begin first": lambda: StepShield(PAPER, 1).decide(np.zeros(3)),
    "shield: proposed (3,); (5,) is needed": lambda: started().decide(np.zeros(3)),
    "shield: begin in row 7 of a batch of 5: a larger batch begins with all of its rows at once": lambda: (
        started().begin(WORLDS.take([0, 1]), np.array([3, 7]))
    ),
    "certify: proposed (2,), backup's harm (5,), budget (5,); (5,), and twice (5,) needed": lambda: certify(
        started().memory.running, np.zeros(2), started().memory.backup, started().bound
    ),
    "certify: a budget is below the backup's harm; nothing could be guaranteed": lambda: certify(
        started().memory.running, np.zeros(5), started().memory.backup, started().bound - 1.0
    ),
    "shield: plan (5, 3); (5, at least 75) is needed": lambda: plan_harm(started().memory.running, np.zeros((5, 3))),
    "certify: proposed (1,), backup's harm (1,), budget (1,); (1, 2), and twice (1,) needed": lambda: certify(
        team().memory.running, np.zeros(1), team().memory.backup, team().bound
    ),
    "shield: plan (1, 81); (1, at least 75, 2) is needed": lambda: plan_harm(team().memory.running, np.zeros((1, 81))),
    "shield: vehicle = (2, 1): several are named front to rear, each once": lambda: StepShield(PAIR, (2, 1)),
    "shield: vehicle = (): must be an index from 0 to 2": lambda: StepShield(PAIR, ()),
    "shield: cap 'baseline' and 5 possible worlds: give one of the two": lambda: StepShield(
        PAPER, 1, cap="baseline"
    ).begin(WORLDS.take([0]), np.arange(1), BRAKE, possible=WORLDS),
    "shield: policies for vehicles [1], shielded are [1, 2]": lambda: StepShield(PAIR, (1, 2)).begin(
        PAIR.sample(1, 0).worlds, np.arange(1), COAST
    ),
    "shield: told of 2 worlds, but row 4 begins": lambda: drive(
        WORLDS, ShieldedDriver(COAST, PAPER, told=WORLDS.take([0, 1])), PAPER, 1
    ),
    "review: nothing was logged; make the shield with logging=True, and drive behind it": lambda: review(
        drive(WORLDS, ShieldedDriver(COAST, PAPER), PAPER, 1).guarded.shield, COAST, WORLDS
    ),
    "review: 5 worlds, but 1 were driven last": lambda: review(
        drive(WORLDS.take([0]), ShieldedDriver(COAST, PAPER, logging=True), PAPER, 1).guarded.shield, COAST, WORLDS
    ),
}


@pytest.mark.parametrize("message", STEP_SHIELD)
def test_step_shield__refuses(message: str) -> None:
    with refused(message):
        STEP_SHIELD[message]()


AGENTS: dict[str, Callable[[], object]] = {
    "must be a Scenario; eb.load_scenario(name) loads one": lambda: ShieldedDriver(COAST, "paper-random"),
    "step: told = 3: must be worlds at the alert, or None": lambda: ShieldedDriver(COAST, PAPER, told=3),
    "shield: mode = 'episode': HybridAgent is that of mode episode": lambda: ShieldedDriver(
        COAST, PAPER, mode="episode"
    ),
    "agent 'coast+step' drives vehicle_2, but vehicle_3 of scenario 'cooperation-3-pair'": lambda: drive(
        PAIR.sample(1, 0).worlds, ShieldedDriver(COAST, PAIR), PAIR, 1
    ),
    "team 'half': does not drive vehicle_3; beside a shielded vehicle every other one is shielded too": lambda: (
        ShieldedDriver(Team({1: COAST}, "half"), PAIR)
    ),
    "e_v2x_bm mode 'couple': must be 'coupled' or 'pairwise'": lambda: HybridAgent(BRAKE, PAPER, bound="couple"),
    "harm_count 'both': must be 'first' or 'total'": lambda: HybridAgent(BRAKE, PAPER, harm_count="both"),
    "shield: agent 'coast' needs scenario=, in which to certify, and takes no policy": lambda: eb.shield(COAST),
    "shield: agent 'coast+step' is behind a shield already": lambda: eb.shield(
        make_agent("coast+step", scenario=PAPER), scenario=PAPER
    ),
}


@pytest.mark.parametrize("message", AGENTS)
def test_agent_behind_a_shield__is_refused(message: str) -> None:
    with refused(message):
        AGENTS[message]()


OPTIONS: dict[str, Callable[[], object]] = {
    "shield: cap = 'baseline': mode step alone takes one": lambda: ShieldOptions(mode="episode", cap="baseline"),
    "shield: bound = 'pairwise': mode step takes none; episode does": lambda: ShieldOptions(
        mode="step", bound="pairwise"
    ),
    "shield: cap = 'mine': must be baseline or None": lambda: ShieldOptions(cap="mine"),
    "shield: intervention_penalty = -1.0: must be a number, at least 0": lambda: ShieldOptions(
        intervention_penalty=-1.0
    ),
    "shield: intervention_penalty = nan: must be a number, at least 0": lambda: ShieldOptions(
        intervention_penalty=float("nan")
    ),
}


@pytest.mark.parametrize("message", OPTIONS)
def test_options__are_refused(message: str) -> None:
    with refused(message):
        OPTIONS[message]()


AROUND: dict[str, Callable[[], object]] = {
    "ShieldedVecEnv: bound = 'pairwise': mode step takes none; episode does": lambda: ShieldedVecEnv(
        make_sb3_vec_env(PAPER, 2), mode="step", bound="pairwise"
    ),
    "HybridShield: goes around eb.parallel_env, not None; eb.shield(env) chooses the one": lambda: HybridShield(
        None, BRAKE
    ),
    "ShieldedEnv: goes around gymnasium.make('EthBrake-v0')": lambda: ShieldedEnv(gymnasium.make("CartPole-v1")),
    "policy = 'ppo': must be an agent or a policy (eb.load_policy); wrap a function by eb.policy_agent": lambda: (
        HybridShield(parallel_env(), "ppo")
    ),
    "HybridShield: agents = 5: must be a list of names": lambda: HybridShield(parallel_env(), BRAKE, agents=5),
    "HybridShield: shields every learner, ('vehicle_2',), and nobody else; got ('vehicle_1',). What": lambda: (
        HybridShield(parallel_env(), BRAKE, agents=["vehicle_1"])
    ),
    "HybridShield: policy: one for each of vehicle_2, vehicle_3 is needed, and for nobody else": lambda: HybridShield(
        parallel_env(PAIR), {"vehicle_2": COAST}, mode="step"
    ),
    "scenario 'cooperation-3-pair' has 2 learners (vehicle_2, vehicle_3); HybridShield needs exactly one": lambda: (
        HybridShield(parallel_env(PAIR), COAST, mode="episode")
    ),
    "no vehicle of scenario 'paper-random' learns, so there is nobody to shield; pass": lambda: HybridShield(
        parallel_env(learners=[]), BRAKE, mode="step"
    ),
    "HybridShield: goes around eb.parallel_env, not ethbrake_v0; eb.shield(env) chooses the one": lambda: HybridShield(
        aec_env(), mode="step"
    ),
    "shield: BaseWrapper<ethbrake_v0> acts in turns: put the shield inside it": lambda: eb.shield(
        BaseWrapper(aec_env())
    ),
    "shield: None has none of the interfaces: parallel_env, env (agents in turn), EthBrakeEnv": lambda: eb.shield(None),
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
    with refused("(mode step) shields this environment already, and its bound holds for one shield alone"):
        ALREADY[interface]()


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ({}, "shield: no action was given, and there is no policy that could propose one"),
        ([0.0], "step: actions = [0.0]: must be a mapping from agent to action, such as {'vehicle_2': [-1.0]}"),
        ({"vehicle_2": np.array([np.nan])}, "action of vehicle_2: nan; must be from -1 (full braking) to 1 (full"),
        ({"vehicle_2": np.array([1.5])}, "action of vehicle_2: 1.5; must be from -1 (full braking) to 1 (full"),
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
    with refused("action of vehicle_2: 3.0; must be from -1 (full braking) to 1 (full driving)"):
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
    with refused("ShieldedVecEnv: this shield was closed; put a new one around the environment"):
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
    with refused("ShieldedEnv: another environment is inside than the one that is shielded"):
        shielded.reset(seed=8)
