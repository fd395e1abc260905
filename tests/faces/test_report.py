"""Terms that infos report, with or without a weight in the reward."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.errors import InvalidInput, UnknownName
from tests.contract.interfaces import BARE, CRASH, FIVE, PAPER, STEP, actions
from tests.refused import refused

LATE = PAPER.replace(horizon_s=1.2)
NAMES = ["harm", "collision", "risk", "jerk", "terminal", "push", "drove", "still_moving", "shaping", "each", "line"]


def each(before: eb.State, step: eb.Step, after: eb.State) -> Any:
    """Speed of each vehicle."""
    return after.speeds_mps


def line(before: eb.State, step: eb.Step, after: eb.State) -> Any:
    """Mean speed of the line."""
    return after.speeds_mps.mean(axis=1)


@pytest.fixture(autouse=True)
def _registered() -> None:
    eb.register_term("each", each)
    eb.register_term("line", line)


def played(env: Any, steps: int = 7) -> list[Any]:
    """Rewards and infos of an episode in PettingZoo's form."""
    values: list[Any] = [env.reset(seed=7)[1]]
    learners = [f"vehicle_{body}" for body in env.game.settings.learners]
    for action in actions(3, steps, len(learners)):
        _, rewards, *_, infos = env.step(dict(zip(learners, action, strict=True)))
        values.append((rewards, infos))
    return values


def of(values: list[Any], name: str) -> list[Any]:
    return [{agent: info[f"reward_{name}"] for agent, info in infos.items()} for _, infos in values[1:]]


@pytest.mark.parametrize(
    ("scenario", "name"),
    [*((FIVE.replace(horizon_s=1.2), name) for name in ("harm", "push", "shaping", "each", "line")), (CRASH, "harm")],
    ids=lambda value: value if isinstance(value, str) else value.name,
)
def test_report__is_the_term_that_would_be_rewarded(scenario: eb.Scenario, name: str) -> None:
    weights = {"harm": 0.0, "collision": 0.5} | {name: 2.0}
    rewarded = played(eb.parallel_env(scenario, reward=weights))
    bare = {"harm": 0.0, "collision": 0.5} if name != "collision" else {"harm": 1.0}
    reported, silent = (played(eb.parallel_env(scenario, reward=bare, **more)) for more in ({"report": [name]}, {}))
    assert of(reported, name) == of(rewarded, name) != []
    assert all(info[f"reward_{name}"] == 0.0 for info in reported[0].values())
    assert [rewards for rewards, _ in reported[1:]] == [rewards for rewards, _ in silent[1:]]
    assert f"reward_{name}" not in silent[1][1]["vehicle_2"]


@pytest.mark.parametrize("interface", [*BARE, "shielded vector"])
def test_report__is_in_the_infos_of_every_interface(interface: str) -> None:
    steps, settings = {**BARE, **STEP}[interface], {"reward": {"harm": 1.0, "line": 0.0}, "report": NAMES}
    env, expected = steps(LATE, 1, **settings).env, None
    if interface.endswith("sb3"):
        env.set_attr("step_infos", True)
        env.seed(7)
        env.reset()
        infos = env.step(np.array([[-0.5]]))[3][0]
    elif interface.endswith("vector"):
        env.reset(seed=7)
        infos = {name: column[0] for name, column in env.step(np.array([[-0.5]]))[4].items()}
    elif interface.endswith("turn"):
        env.reset(seed=7)
        for agent in env.possible_agents:
            env.step([-0.5] if agent == "vehicle_2" else None)
        infos = env.infos["vehicle_2"]
    else:
        env.reset(seed=7)
        action = [-0.5] if interface.endswith("single") else {"vehicle_2": [-0.5]}
        *_, infos = env.step(action)
        infos = infos.get("vehicle_2", infos)
    plain = eb.EthBrakeEnv(LATE, **settings)
    plain = eb.shield(plain) if "shielded" in interface else plain
    plain.reset(seed=7)
    expected = plain.step([-0.5])[4]
    assert {f"reward_{name}": infos[f"reward_{name}"] for name in NAMES} == {
        f"reward_{name}": expected[f"reward_{name}"] for name in NAMES
    }
    assert expected["reward_each"] > 10.0 and expected["reward_jerk"] < 0.0


def test_report__beside_vector_rewards_and_the_objective_of_harm() -> None:
    own = LATE.replace(objective="own", horizon_s=2.5)
    both = {
        "reward": {"harm": 1.0, "each": 0.5},
        "reward_vector": ["harm_1", "each"],
        "report": ["each", "jerk", "jerk"],
    }
    values = played(eb.parallel_env(own, **both), 20)
    for rewards, infos in values[1:]:
        assert all(rewards[agent][1] == infos[agent]["reward_each"] for agent in rewards)
        assert {name for name in infos["vehicle_1"] if name.startswith("reward_")} == {
            "reward_harm", "reward_each", "reward_jerk",
        }  # fmt: skip
    harm = [
        played(eb.parallel_env(own, reward=reward, report=["harm"]), 20)
        for reward in ({"harm": 0, "risk": 1}, "honest")
    ]
    assert of(harm[0], "harm") == of(harm[1], "harm")
    assert any(len(set(values.values())) > 1 for values in of(harm[0], "harm"))  # each vehicle's own


REFUSED: dict[str, Callable[[], Any]] = {
    "unknown term 'risky'; did you mean 'risk'": lambda: eb.parallel_env(PAPER, report=["risky"]),
    "unknown term 'harm_1'": lambda: eb.EthBrakeEnv(PAPER, report=["jerk", "harm_1"]),
    "report = 'risk': must be a list of names of terms": lambda: eb.make_sb3_vec_env(PAPER, 2, report="risk"),
    # type: ignore[arg-type]
}


@pytest.mark.parametrize("message", REFUSED)
def test_report__refuses_what_is_no_list_of_terms(message: str) -> None:
    with refused(message, UnknownName if message.startswith("unknown") else InvalidInput):
        REFUSED[message]()
