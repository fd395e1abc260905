"""What shields refuse: options, uncertainties, environments that they do not go around, and use out of order."""

from collections.abc import Callable
from functools import cache

import gymnasium
import numpy as np
import pytest
from pettingzoo.utils import BaseWrapper
from stable_baselines3.common.vec_env import VecMonitor

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import UncertifiedStep, UnknownName
from ethbrake_marl.first_edition.agents.driving import drive
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.envs.gymnasium import EthBrakeEnv
from ethbrake_marl.first_edition.envs.pettingzoo import parallel_env
from ethbrake_marl.first_edition.envs.sb3 import make_sb3_vec_env
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.shields.certify import certify, plan_harm
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver
from ethbrake_marl.first_edition.shields.evidence import review
from ethbrake_marl.first_edition.shields.options import ShieldOptions
from ethbrake_marl.first_edition.shields.paper_hybrid import HybridAgent
from ethbrake_marl.first_edition.shields.sb3 import ShieldedVecEnv
from ethbrake_marl.first_edition.shields.step import StepShield
from ethbrake_marl.first_edition.shields.wrappers import HybridShield, ShieldedEnv, shielded_aec
from tests.first_edition.shield.attacks import begun
from tests.refused import refused

PAPER, PAIR = load_scenario("paper-random"), load_scenario("cooperation-3-pair")
WORLDS = PAPER.sample(5, 3).worlds
BRAKE, COAST = make_agent("full_brake"), make_agent("coast")


@cache
def started() -> StepShield:
    """A shield of Vehicle 2 in five episodes."""
    return begun(PAPER, WORLDS)


STEP_SHIELD: dict[str, Callable[[], object]] = {
    "shield: vehicle = 9: must be an index": lambda: StepShield(PAPER, 9),
    "shield: allowance = -1.0: must be a": lambda: StepShield(PAPER, 1, allowance=-1.0),
    "shield: decide() was called before any": lambda: StepShield(PAPER, 1).decide(np.zeros(3)),
    "shield: proposed has the shape (3,);": lambda: started().decide(np.zeros(3)),
    "shield: begin was called for row 7, but": lambda: started().begin(WORLDS.take([0, 1]), np.array([3, 7])),
    "certify: the shapes of proposed,": lambda: certify(
        started().memory.running, np.zeros(2), started().memory.backup, started().bound
    ),
    "certify: in every world, budget must be": lambda: certify(
        started().memory.running, np.zeros(5), started().memory.backup, started().bound - 1.0
    ),
    "shield: plan has the shape (5, 3); must": lambda: plan_harm(started().memory.running, np.zeros((5, 3))),
    "shield: vehicle = (2, 1): must be": lambda: StepShield(PAIR, (2, 1)),
    "shield: cap = 'baseline': must be None": lambda: StepShield(PAPER, 1, cap="baseline").begin(
        WORLDS.take([0]), np.arange(1), BRAKE, possible=WORLDS
    ),
    "shield: policy has a policy for the": lambda: StepShield(PAIR, (1, 2)).begin(
        PAIR.sample(1, 0).worlds, np.arange(1), COAST
    ),
    "shield: assumed has 2 worlds, but the": lambda: drive(
        WORLDS, ShieldedDriver(COAST, PAPER, assumed=WORLDS.take([0, 1])), PAPER, 1
    ),
    "review: the shield has no log; make the": lambda: review(
        drive(WORLDS, ShieldedDriver(COAST, PAPER), PAPER, 1).guarded.shield, COAST, WORLDS
    ),
    "review: worlds has 5 worlds; pass the": lambda: review(
        drive(WORLDS.take([0]), ShieldedDriver(COAST, PAPER, logging=True), PAPER, 1).guarded.shield, COAST, WORLDS
    ),
}


@pytest.mark.parametrize("message", STEP_SHIELD)
def test_step_shield__refuses(message: str) -> None:
    with refused(message):
        STEP_SHIELD[message]()


AGENTS: dict[str, Callable[[], object]] = {
    "must be a Scenario;": lambda: ShieldedDriver(COAST, "paper-random"),
    "step: assumed = 3: must be None or a": lambda: ShieldedDriver(COAST, PAPER, assumed=3),
    "shield: mode = 'episode': is not": lambda: ShieldedDriver(COAST, PAPER, mode="episode"),
    "e_v2x_bm: mode = 'couple': must be": lambda: HybridAgent(BRAKE, PAPER, bound="couple"),
    "shield: to shield the agent 'coast',": lambda: eb.shield(COAST),
    "shield: agent 'coast+step' already has": lambda: eb.shield(
        make_agent("coast+step", scenario=PAPER), scenario=PAPER
    ),
}


@pytest.mark.parametrize("message", AGENTS)
def test_agent_behind_a_shield__is_refused(message: str) -> None:
    with refused(message):
        AGENTS[message]()


OPTIONS: dict[str, Callable[[], object]] = {
    "shield: cap = 'baseline': cap is": lambda: ShieldOptions(mode="episode", cap="baseline"),
    "shield: bound = 'pairwise': not a": lambda: ShieldOptions(mode="step", bound="pairwise"),
}


@pytest.mark.parametrize("message", OPTIONS)
def test_options__are_refused(message: str) -> None:
    with refused(message):
        OPTIONS[message]()


AROUND: dict[str, Callable[[], object]] = {
    "HybridShield: None: must be an": lambda: HybridShield(None, BRAKE),
    "policy = 'ppo': must be an agent or a": lambda: HybridShield(parallel_env(), "ppo"),
    "HybridShield: agents = 5: must be a": lambda: HybridShield(parallel_env(), BRAKE, agents=5),
    "HybridShield: agents = ('vehicle_1',):": lambda: HybridShield(parallel_env(), BRAKE, agents=["vehicle_1"]),
    "HybridShield: policy must have one": lambda: HybridShield(parallel_env(PAIR), {"vehicle_2": COAST}, mode="step"),
    "no vehicle of scenario 'paper-random'": lambda: HybridShield(parallel_env(learners=[]), BRAKE, mode="step"),
}


@pytest.mark.parametrize("message", AROUND)
def test_environment__is_refused(message: str) -> None:
    with refused(message):
        AROUND[message]()


NAMES: dict[str, Callable[[], object]] = {
    "unknown HybridShield option": lambda: HybridShield(parallel_env(), allowence=1.0)
}


@pytest.mark.parametrize("message", NAMES)
def test_name__is_unknown(message: str) -> None:
    with refused(message, UnknownName):
        NAMES[message]()


ALREADY: dict[str, Callable[[], object]] = {
    "HybridShield": lambda: HybridShield(HybridShield(parallel_env(), mode="step").unwrapped),
    "agents in turn in a wrapper": lambda: HybridShield(BaseWrapper(shielded_aec(parallel_env()))),
    "ShieldedVecEnv": lambda: ShieldedVecEnv(VecMonitor(ShieldedVecEnv(make_sb3_vec_env(PAPER, 2)))),
}


@pytest.mark.parametrize("interface", ALREADY)
def test_second_shield__is_refused_because_a_bound_holds_for_one_alone(interface: str) -> None:
    with refused("(mode step), and can have only one; close() that shield before you add another"):
        ALREADY[interface]()


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ({}, "shield: the action of a vehicle is"),
        ({"vehicle_2": np.array([1j])}, "action of vehicle_2: array([0.+1.j]) is"),
    ],
)
def test_action__is_refused(actions: object, message: str) -> None:
    env = HybridShield(parallel_env(), mode="step")
    env.reset(seed=1)
    with refused(message):
        env.step(actions)


def test_closed_shield__is_refused_and_cannot_be_used() -> None:
    env = ShieldedEnv(EthBrakeEnv())
    env.close()
    with refused("ShieldedEnv: <ShieldedEnv<EthBrakeEnv instance>> is a shield that was closed"):
        eb.shield(env)
    many = ShieldedVecEnv(make_sb3_vec_env(PAPER, 2))
    many.close()
    with refused("ShieldedVecEnv: this shield was closed; put a new shield around the environment"):
        many.reset()


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
