"""What shields refuse: options, uncertainties, environments that they do not go around, and use out of order."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import gymnasium
import numpy as np
import pytest
from pettingzoo.utils import BaseParallelWrapper, BaseWrapper
from stable_baselines3.common.vec_env import VecMonitor

import ethbrake_marl as eb
from ethbrake_marl.agents.driving import drive
from ethbrake_marl.agents.protocol import Team
from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.envs.gymnasium import EthBrakeEnv
from ethbrake_marl.envs.pettingzoo import env as aec_env, parallel_env
from ethbrake_marl.envs.sb3 import make_sb3_vec_env
from ethbrake_marl.envs.vector import EthBrakeVectorEnv
from ethbrake_marl.errors import UncertifiedStep, UnknownName
from ethbrake_marl.extensions.certified.options import checked_uncertainty
from ethbrake_marl.extensions.certified.robust_step import RobustShield
from ethbrake_marl.extensions.certified.uncertainty import Interval, Uncertainty, parse_uncertainty
from ethbrake_marl.scenario.catalogue import load_scenario
from ethbrake_marl.scenario.schema import Scenario
from ethbrake_marl.shield.certify import certify, plan_harm
from ethbrake_marl.shield.drivers import ShieldedDriver
from ethbrake_marl.shield.evidence import review
from ethbrake_marl.shield.options import ShieldOptions
from ethbrake_marl.shield.paper_hybrid import HybridAgent
from ethbrake_marl.shield.sb3 import ShieldedVecEnv
from ethbrake_marl.shield.step import StepShield
from ethbrake_marl.shield.wrappers import HybridShield, ShieldedEnv, ShieldedVectorEnv, shielded_aec
from tests.fixtures.lines import line as one_line
from tests.refused import refused
from tests.shield.attacks import begun, line

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
        started().running, np.zeros(2), started().backup, started().bound
    ),
    "certify: a budget is below the backup's harm; nothing could be guaranteed": lambda: certify(
        started().running, np.zeros(5), started().backup, started().bound - 1.0
    ),
    "shield: plan (5, 3); (5, at least 75) is needed": lambda: plan_harm(started().running, np.zeros((5, 3))),
    "certify: proposed (1,), backup's harm (1,), budget (1,); (1, 2), and twice (1,) needed": lambda: certify(
        team().running, np.zeros(1), team().backup, team().bound
    ),
    "shield: plan (1, 81); (1, at least 75, 2) is needed": lambda: plan_harm(team().running, np.zeros((1, 81))),
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
    "mode robust needs an uncertainty, for instance braking_capacity_mps2=5%": lambda: make_agent(
        "full_brake+robust", scenario=PAIR
    ),
    "e_v2x_bm mode 'couple': must be 'coupled' or 'pairwise'": lambda: HybridAgent(BRAKE, PAPER, bound="couple"),
    "harm_count 'both': must be 'first' or 'total'": lambda: HybridAgent(BRAKE, PAPER, harm_count="both"),
    "agent 'coast+step:believed+robust': +search comes first and once, then one shield of +episode": lambda: make_agent(
        "coast+step:believed+robust", scenario=PERIODIC
    ),
    "agent 'e_v2x_bm:believed+episode:believed': e_v2x_bm:believed decides on what was received itself": lambda: (
        make_agent("e_v2x_bm:believed+episode:believed", scenario=PERIODIC)
    ),
    "shield: robust interior: total harm: it certifies first-impact harm of at most 3 vehicles without": lambda: (
        make_agent("coast+robust:interior:believed", scenario=PERIODIC, harm_count="total")
    ),
    "shield: robust interior: an obstacle ahead: it certifies first-impact harm": lambda: make_agent(
        "coast+robust:interior:believed", scenario=PERIODIC.replace(obstacle_gap_m=60.0)
    ),
    "shield: robust interior: 5 vehicles: it certifies first-impact harm of at most 3 vehicles": lambda: RobustShield(
        line(5), 2, uncertainty=parse_uncertainty("gaps_m=0.1"), robust="interior"
    ),
    "shield: agent 'coast' needs scenario=, in which to certify, and takes no policy": lambda: eb.shield(COAST),
    "shield: agent 'coast+step' is behind a shield already": lambda: eb.shield(
        make_agent("coast+step", scenario=PAPER), scenario=PAPER
    ),
}


@pytest.mark.parametrize("message", AGENTS)
def test_agent_behind_a_shield__is_refused(message: str) -> None:
    with refused(message):
        AGENTS[message]()


UNCERTAINTIES: dict[str, Callable[[], object]] = {
    "uncertainty: '': entry 1 is empty; it must be quantity=half-width": lambda: parse_uncertainty(""),
    "uncertainty: 'latency_s': must be quantity=half-width, for instance braking_capacity_mps2=5%": lambda: (
        parse_uncertainty("latency_s")
    ),
    "uncertainty: 'latency_s=-0.1': must be quantity=half-width": lambda: parse_uncertainty("latency_s=-0.1"),
    "uncertainty: 'latency_s=nan': must be quantity=half-width": lambda: parse_uncertainty("latency_s=nan"),
    "uncertainty: latency_s: half-width inf: must be a number, at least 0": lambda: parse_uncertainty(
        "latency_s=1e999"
    ),
    "uncertainty: latency_s: half-width 1.0: must be a share from 0": lambda: parse_uncertainty("latency_s=100%"),
    "uncertainty: 'latency_s.vehicle_0=0.1': must be quantity=half-width": lambda: parse_uncertainty(
        "latency_s.vehicle_0=0.1"
    ),
    "uncertainty: 'latency_s.pair_1=0.1': gaps_m is of pairs (.pair_1), all else of vehicles (.vehicle_1)": lambda: (
        parse_uncertainty("latency_s.pair_1=0.1")
    ),
    "uncertainty: latency_s=0.1 and latency_s=0.2 speak of the same quantity; give each once": lambda: (
        parse_uncertainty("latency_s=0.1,latency_s=0.2")
    ),
    "uncertainty: latency_s=0.1 and latency_s.vehicle_2=0.2 speak of the same quantity; give each once": lambda: (
        parse_uncertainty("latency_s=0.1,latency_s.vehicle_2=0.2")
    ),
    "uncertainty: mass_t.vehicle_4=0.1: the line has only 3 of these": lambda: parse_uncertainty(
        "mass_t.vehicle_4=0.1"
    ).members(WORLD),
    "uncertainty: mass_t=1: 1 of vehicle_1 in world 0 may be as low as 0; it must stay above 0": lambda: (
        parse_uncertainty("mass_t=1").members(WORLD)
    ),
    "gaps_m=1e+308: 10 of vehicle_1 to vehicle_2 in world 0 may be as high as 1e+308; must be finite": lambda: (
        parse_uncertainty("gaps_m=1e308").members(WORLD)
    ),
    "11 uncertain numbers in each world make 2048 corners; at most 1024 can be certified: name vehicles": lambda: (
        parse_uncertainty("latency_s=0.1,mass_t=0.1,speeds_mps=1,gaps_m=1").members(WORLD)
    ),
    "uncertainty: no interval; one": lambda: Uncertainty(()),
    "must be a tuple of Interval; parse_uncertainty reads it": lambda: Uncertainty("gaps_m=0.5"),
    "uncertainty: latency_s: half-width -1.0: must be a number, at least 0": lambda: Interval("latency_s", -1.0),
    "uncertainty: gaps_m: half-width True: must be a number, at least 0": lambda: Interval("gaps_m", True),
    "uncertainty: gaps_m: place 0.5: must be an index from 0": lambda: Interval("gaps_m", 0.5, place=0.5),
    "uncertainty: gaps_m: place -1: must be an index from 0": lambda: Interval("gaps_m", 0.5, place=-1),
    "uncertainty = 0.1: must be an Uncertainty or text": lambda: checked_uncertainty(0.1),
}


@pytest.mark.parametrize("message", UNCERTAINTIES)
def test_uncertainty__is_refused(message: str) -> None:
    with refused(message):
        UNCERTAINTIES[message]()


OPTIONS: dict[str, Callable[[], object]] = {
    "shield: mode step takes no uncertainty; robust does": lambda: ShieldOptions(mode="step", uncertainty="gaps_m=1"),
    "shield: robust = 'interior': mode step takes none; robust does": lambda: ShieldOptions(
        mode="step", robust="interior"
    ),
    "shield: allowance = 5.0: mode episode takes none; step and robust do": lambda: ShieldOptions(
        mode="episode", allowance=5.0
    ),
    "shield: logging = True: mode episode takes none; step and robust do": lambda: ShieldOptions(
        mode="episode", logging=True
    ),
    "shield: shares = True: mode episode takes none; step and robust do": lambda: ShieldOptions(
        mode="episode", shares=True
    ),
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
    "shield: believed = True: mode episode takes none; step and robust do": lambda: ShieldOptions(
        mode="episode", believed=True
    ),
    "not together with believed = True, which certifies against": lambda: ShieldOptions(believed=True, allowance=1.0),
    "shield: cap = 'baseline': not together with believed = True": lambda: ShieldOptions(believed=True, cap="baseline"),
    "shield: uncertainty = 'gaps_m=0.5': not together with believed = True": lambda: ShieldOptions(
        believed=True, mode="robust", uncertainty="gaps_m=0.5"
    ),
    "shield: believed = 'yes': must be True or False": lambda: ShieldOptions(believed="yes"),
}


@pytest.mark.parametrize("message", OPTIONS)
def test_options__are_refused(message: str) -> None:
    with refused(message):
        OPTIONS[message]()


AROUND: dict[str, Callable[[], object]] = {
    "ShieldedEnv: mode robust needs an uncertainty, for instance braking_capacity_mps2=5%": lambda: ShieldedEnv(
        EthBrakeEnv(), mode="robust"
    ),
    "ShieldedVecEnv: bound = 'pairwise': mode step takes none; episode does": lambda: ShieldedVecEnv(
        make_sb3_vec_env(PAPER, 2), mode="step", bound="pairwise"
    ),
    "HybridShield: goes around eb.parallel_env, not None; eb.shield(env) chooses the one": lambda: HybridShield(
        None, BRAKE
    ),
    "ShieldedEnv: goes around gymnasium.make('EthBrake-v0')": lambda: ShieldedEnv(gymnasium.make("CartPole-v1")),
    "policy = 'ppo@shipped': must be an agent or a policy (eb.load_policy), which says what it observes": lambda: (
        HybridShield(parallel_env(), "ppo@shipped")
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
    "HybridShield: believed = True: shields one learner, not several; pass learners=['vehicle_2']": lambda: (
        HybridShield(parallel_env(PAIR), mode="step", believed=True)
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
    "unknown uncertain quantity 'latencys'; did you mean 'latency_s'?": lambda: parse_uncertainty("latencys=0.1"),
    "unknown shield mode 'robus'; did you mean 'robust'?": lambda: ShieldOptions(mode="robus"),
    "unknown shield: robust 'edges'": lambda: ShieldOptions(uncertainty="gaps_m=1", robust="edges"),
    "unknown HybridShield option 'allowence'; did you mean 'allowance'?": lambda: HybridShield(
        parallel_env(), allowence=1.0
    ),
    "unknown shield or search 'step:pairwise:believed'; did you mean 'episode:pairwise:believed'?": lambda: make_agent(
        "coast+step:pairwise:believed", scenario=PERIODIC
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


def test_mixture__believed_agents_need_one_of_its_scenarios() -> None:
    members = [{"scenario": load_scenario(name).declared()} for name in ("paper-random", "paper-random-brake-only")]
    with refused(
        "is a mixture, and a vehicle that is not known could be of any of paper-random, paper-random-brake-only"
    ):
        ShieldedEnv(EthBrakeEnv(Scenario(name="mixed", mixture=members)), believed=True)


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ({}, "shield: no action was given, and there is no policy that could propose one"),
        ([0.0], "step: actions = [0.0]: must be a mapping such as {'vehicle_2': [-1.0]}"),
        ({"vehicle_2": np.array([np.nan])}, "action of vehicle_2: nan; must be in [-1, 1]"),
        ({"vehicle_2": np.array([1.5])}, "action of vehicle_2: 1.5; must be in [-1, 1]"),
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
    with refused("action of vehicle_2: 3.0; must be in [-1, 1], from full braking to full driving"):
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
    with refused("engine snapshot: a shield stands in this engine; restore first, then put the shield around"):
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
    with refused("shield: this episode began before the shield was put around it; reset first", UncertifiedStep):
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


def test_estimated_worlds__that_leave_too_much_open_are_refused() -> None:
    wide = {"braking_capacity_mps2": {"uniform": [3, 9]}, "mass_t": {"uniform": [2, 9]}, "driving_capacity_mps2": 3.0}
    wide = PAPER.replace(vehicles=4, latency_s=0.1, v2x="nominal", roles={"vehicle_2": "learner"}, **wide)
    with refused(
        "leaves 14 numbers of the other vehicles open, which make 16384 corners; at most 1024 can be certified"
    ):
        make_agent("coast+robust:believed", scenario=wide)


def test_uncertain_latency__ends_before_the_horizon() -> None:
    with refused(
        "uncertainty: latency_s=1000: vehicle_2 may decide first at 1000.5 s; must be before the horizon, 8 s"
    ):
        begun(PAPER, WORLDS, uncertainty=parse_uncertainty("latency_s=1000"))


def test_interior__takes_no_brakes_that_began_to_build_up_before() -> None:
    slow = PAPER.replace(brake_rate_mps3=9)
    braking = replace(slow.sample(1, 3).worlds, command_mps2=np.full((1, 3), -1.0))
    shield = RobustShield(slow, 1, uncertainty=parse_uncertainty("gaps_m=0.1"), robust="interior")
    with refused("shield: robust interior: brakes that began to build up before the alert"):
        shield.begin(braking, np.arange(1))


def test_interior__takes_no_script_that_it_cannot_enclose() -> None:
    roles = {"vehicle_1": "full_brake", "vehicle_2": "learner", "vehicle_3": "e_v2x_bm:pairwise"}
    gentle = PAPER.replace(early_impacts="keep", roles=roles)
    with refused(
        "vehicle_3 is driven by 'e_v2x_bm:pairwise', which it cannot enclose; full_brake, coast and constant:A"
    ):
        RobustShield(gentle, 1, uncertainty=parse_uncertainty("gaps_m.pair_1=0.1"), robust="interior")


def test_interior__takes_no_command_beyond_the_least_capacity() -> None:
    weak = line(3).replace(braking_capacity_mps2=[6.0, 6.0, 5.2])  # vehicle_3 holds 5 m/s2, which 4.68 cannot
    shield = RobustShield(weak, 1, uncertainty=parse_uncertainty("braking_capacity_mps2=10%"), robust="interior")
    with refused("uncertainty: braking_capacity_mps2=10%: agent 'constant:5': above the braking capacity 4.68 m/s2"):
        shield.begin(weak.sample(1, 0).worlds, np.arange(1))
