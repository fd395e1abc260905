"""What agents, policies of others and teams refuse, and how an agent fails."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import AgentFailed, AlreadyExists, UnknownName
from ethbrake_marl.first_edition.agents.e_v2x_bm.pairwise import optimise_pairwise, pairwise_harm
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.agents.protocol import Team
from ethbrake_marl.first_edition.agents.registry import register_agent
from ethbrake_marl.first_edition.game.observations import observe
from tests.refused import refused

PAPER, PAIR = eb.load_scenario("paper-random"), eb.load_scenario("cooperation-3-pair")
WORLDS = PAPER.sample(12, 7).worlds
BRAKE = make_agent("full_brake")


class Own:
    """An agent that gives this answer."""

    def __init__(self, answer: Callable[[Any], Any], name: str = "own") -> None:
        self.answer, self.name = answer, name

    def act(self, worlds: Any, vehicle: int) -> Any:
        return self.answer(worlds)


class Remembers:
    """An agent that makes and keeps a memory so."""

    name = "mine"

    def __init__(self, begun: Callable[[int], Any], kept: Callable[[Any, int], Any]) -> None:
        self.begun, self.kept = begun, kept

    def begin(self, alert: Any, vehicle: int, scripts: Any) -> Any:
        return self.begun(alert.n)

    def act(self, worlds: Any, memory: Any, vehicle: int) -> Any:
        return np.zeros(worlds.n), self.kept(memory, worlds.n)


def evaluated(agent: Any, scenario: eb.Scenario = PAPER) -> object:
    return eb.evaluate(scenario.sample(12, 7), {"own": agent}, scenario=scenario)


def policy(answer: Callable[[int], Any]) -> Any:
    return eb.policy_agent(lambda seen: answer(len(seen)), name="mine")


SPECS: dict[str, Callable[[], object]] = {
    "agent 'coast:1': coast takes no argument": lambda: make_agent("coast:1"),
    "agent 'full_brake@': a path must follow": lambda: make_agent("full_brake@"),
    "agent 'coast@runs/x': coast does not": lambda: make_agent("coast@runs/x"),
    "agent 'constant': constant needs a": lambda: make_agent("constant"),
    "agent 'e_v2x_bm:total': after the first": lambda: make_agent("e_v2x_bm:total"),
    "harm_count = 'both': must be 'first' or": lambda: make_agent("e_v2x_bm", harm_count="both"),
    "horizon_s = 0.0: must be a finite": lambda: make_agent("e_v2x_bm", horizon_s=0.0),
    "agent name 'mine:x': must be a name": lambda: register_agent("mine:x", Own),
    "file 'nowhere/none.py': does not exist": lambda: make_agent("nowhere/none.py:make_agent"),
    "agent 'profile:0=3,1=5+step': a braking": lambda: make_agent("profile:0=3,1=5+step", scenario=PAPER),
    "agent 'policy' needs a policy: write": lambda: make_agent("policy+step", scenario=PAPER),
}


@pytest.mark.parametrize("message", SPECS)
def test_agent__is_refused(message: str) -> None:
    with refused(message):
        SPECS[message]()


SEARCHES: dict[str, Callable[[], object]] = {
    "vehicle = 3: must be an index from 0 to": lambda: optimise_pairwise(WORLDS, 3),
    "deceleration_mps2[0, 1] = -1: must be": lambda: pairwise_harm(WORLDS.take([0]), [1.0, -1.0, 1.0]),
    "team 't': key 'vehicle_2': must be the": lambda: Team({"vehicle_2": BRAKE}, "t"),
    "team 't': vehicle_2 = 'coast': must be": lambda: Team({1: "coast"}, "t"),
    "team 't': drives vehicle_2; must drive": lambda: Team.of(Team({1: BRAKE}, "t"), (1, 2)),
    "scenario 'cooperation-3-pair': this": lambda: eb.evaluate(PAIR.sample(2, 0), {"b": BRAKE}, scenario=PAIR).vehicle,
    "agent 'coast' drives vehicle_3, but": lambda: eb.evaluate(
        PAIR.sample(2, 0), {"h": make_agent("coast+episode", scenario=PAIR.with_learners(["vehicle_2"]))}, scenario=PAIR
    ),
}


@pytest.mark.parametrize("message", SEARCHES)
def test_command_search_or_team__is_refused(message: str) -> None:
    with refused(message):
        SEARCHES[message]()


OWN: dict[str, Callable[[], object]] = {
    "agent 'own' of vehicle_2: act on 12": lambda: evaluated(Own(lambda worlds: 1 / 0)),
    "memory: act got a memory of the form": lambda: evaluated(Remembers(lambda n: None, lambda m, n: np.zeros(n))),
    "agent 'mine' of vehicle_2: memory: key": lambda: evaluated(
        Remembers(lambda n: {"a": (np.zeros(n), {"b.c": np.zeros(n)})}, lambda m, n: m)
    ),
    "agent 'mine' of vehicle_2: memory:": lambda: evaluated(
        Remembers(lambda n: np.array([[]] * n + [[1]], object)[:n], lambda m, n: m)
    ),
}


@pytest.mark.parametrize("message", OWN)
def test_agent_of_a_user__is_refused(message: str) -> None:
    with refused(message):
        OWN[message]()


FAILED: dict[str, Callable[[], object]] = {
    "agent 'own', world 0, vehicle_2 at 0.50": lambda: evaluated(Own(lambda worlds: np.zeros((worlds.n, 1)))),
    "agent 'own', world 7, vehicle_2 at 0.50": lambda: evaluated(Own(lambda worlds: np.zeros(7))),
    "agent 'own', world 0, step 1 (0.50 s):": lambda: evaluated(policy(lambda n: (np.zeros((n, 1)), None))),
}


@pytest.mark.parametrize("message", FAILED)
def test_agent__fails_with_its_world_and_step(message: str) -> None:
    with refused(message, AgentFailed):
        FAILED[message]()


@pytest.mark.parametrize(
    ("answer", "world", "reason"),
    [
        (lambda n: np.zeros((n, 2)), 0, "; must return one number per world, shape (12, 1)"),
        (lambda n: 1.5 * np.eye(n)[:, 2:3], 2, "; the action for this world is 1.5; must be in [-1, 1]; clip=True"),
    ],
)
def test_policy__fails_with_its_world_and_step(answer: Callable[[int], Any], world: int, reason: str) -> None:
    shape = answer(12).shape
    told = f"returned float64 of shape {shape} for observations of shape (12, 27){reason}"
    with refused(f"agent 'own', world {world}, step 1 (0.50 s): {told}", AgentFailed):
        evaluated(policy(answer))


POLICIES: dict[str, Callable[[], object]] = {
    "agent 'int': policy = 3: must be a": lambda: eb.policy_agent(3),
    "agent 'none': policy = 'none.onnx':": lambda: eb.policy_agent(Path("none.onnx")),
    "agent 'ActorCriticPolicy': the policy": lambda: eb.policy_agent(
        PPO("MlpPolicy", eb.EthBrakeEnv()).policy, observation=eb.ObservationSpec(front=2)
    ),
    "agent 'PPO': initial_state: can only be": lambda: eb.policy_agent(
        PPO("MlpPolicy", eb.EthBrakeEnv()), initial_state=lambda n: np.zeros((n, 1))
    ),
    "agent 'Sequential': the layer Dropout": lambda: eb.policy_agent(
        torch.nn.Sequential(torch.nn.Linear(27, 4), torch.nn.Dropout(0.5), torch.nn.Linear(4, 1))
    ),
}


@pytest.mark.parametrize("message", POLICIES)
def test_policy_of_another_library__is_refused(message: str) -> None:
    with refused(message):
        POLICIES[message]()


NAMES: dict[str, Callable[[], object]] = {
    "unknown agent 'full_break'; did you": lambda: make_agent("full_break"),
    "unknown shield or search 'stpe'; did": lambda: make_agent("full_brake+stpe", scenario=PAPER),
}


@pytest.mark.parametrize("message", NAMES)
def test_name__is_unknown(message: str) -> None:
    with refused(message, UnknownName):
        NAMES[message]()


FILE = """import numpy as np, ethbrake_marl as eb
def make_agent(): return eb.policy_agent(lambda seen: np.full((len(seen), 1), -0.5), name="half")
def wrong(): return 3
def raising(): raise KeyError("weights")"""


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("My+File.py:", "agent 'My+File.py:': an agent from a"),
        ("My+File.py:make_agent:3", "make_agent has no parameters; write the"),
        ("My+File.py:wrong", "agent 'My+File.py:wrong': 'int' is not"),
        ("My+File.py:raising", "agent 'My+File.py:raising': KeyError:"),
        ("My+File.py:nobody", "file 'My+File.py': does not define"),
    ],
)
def test_file_of_an_agent__is_refused(spec: str, message: str, empty_folder: Path) -> None:
    Path("My+File.py").write_text(FILE)
    with refused(message):
        make_agent(spec, scenario=PAPER)


def test_file_of_an_agent__is_not_run_for_a_role(empty_folder: Path) -> None:
    Path("half.py").write_text("raise SystemExit('this ran')")
    with refused("agent 'half.py:make_agent': is a function in a Python file, which a scenario cannot use (the option"):
        PAPER.replace(roles={"vehicle_1": "half.py:make_agent"})


def test_agent_that_is_registered__takes_a_policy_only_if_it_says_so() -> None:
    with refused("agent 'ppo' is registered already", AlreadyExists):
        register_agent("ppo", Own)
    register_agent("leads", lambda argument, settings: make_agent(f"constant:{argument}"))
    with refused("agent 'leads@anything': leads does not use a policy; leave out @ and what follows; to allow"):
        make_agent("leads@anything")


@pytest.mark.parametrize(
    ("drives", "third"), [(lambda: make_agent("e_v2x_bm").begin(WORLDS, 1, {2: Own(len, "steering")}), "steering")]
)
def test_looking_ahead__needs_commands_that_are_fixed_at_the_alert(drives: Callable[[], object], third: str) -> None:
    with refused(f"vehicle_3 is driven by '{third}', whose command is not fixed at the alert"):
        drives()


def test_agent__has_a_name_and_its_act_takes_a_memory_if_it_begins_with_one() -> None:
    nameless = Own(len)
    del nameless.name
    with refused("evaluate: agent 'own': 'Own' is not an agent, because it has no name; to make an agent"):
        evaluated(nameless)

    class Begins(Own):
        def begin(self, worlds: Any) -> None:
            return None

    with refused("agent 'own' of vehicle_2: the agent has a method begin, but its method act has no argument memory;"):
        evaluated(Begins(len))


@pytest.mark.parametrize("around", ["", "+episode", "+episode:pairwise", "+step"])
def test_failure__is_told_with_its_world_whatever_stands_around_the_agent(around: str) -> None:
    check_failure(around)


def check_failure(around: str) -> None:
    seventh = observe(WORLDS, 1, eb.ObservationSpec())[7, 0]

    def answer(seen: Any) -> Any:
        return 1 / 0 if seventh in seen[:, 0] else np.full((len(seen), 1), -0.5)

    agent = eb.policy_agent(answer, name="mine")
    register_agent("theirs", lambda argument, settings: agent)
    with refused(
        "agent 'mine', world 7, step 1 (0.50 s): observations of shape (5, 27): ZeroDivisionError", AgentFailed
    ):
        eb.evaluate(
            PAPER.sample(12, 7), {"mine": make_agent("theirs" + around, scenario=PAPER)}, scenario=PAPER, chunk=5
        )
