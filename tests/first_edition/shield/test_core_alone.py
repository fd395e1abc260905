"""The core's shields where no extension is installed: they work, and everything else is refused in one line."""

from collections.abc import Callable

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.errors import UnknownName
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.agents.registry import agent_entries
from tests.refused import refused

PAPER = eb.load_scenario("paper-random")


pytestmark = pytest.mark.usefixtures("core_alone")


@pytest.mark.parametrize(("mode", "code"), [(None, 1), ("step", 1), ("episode", 0)])
def test_mode__shields_a_batch(mode: str | None, code: int) -> None:
    env = eb.shield(eb.EthBrakeVectorEnv(4), make_agent("full_brake"), mode=mode)
    env.reset(seed=3)
    infos = env.step(np.ones((4, 1)))[4]
    assert infos["shield_mode"].tolist() == [code] * 4 and infos["shield_intervened"].any()


@pytest.mark.parametrize("spec", ["coast+step", "coast+episode", "coast+episode:pairwise", "e_v2x_bm:pairwise+step"])
def test_agent__drives_behind_each_shield(spec: str) -> None:
    found = eb.evaluate(PAPER.sample(5, 3), {spec: make_agent(spec, scenario=PAPER)}, scenario=PAPER)
    assert np.isfinite(found.outcome(spec).first_impact_harm).all()


def test_list__has_no_variants() -> None:
    forms = [entry.form for entry in agent_entries()]
    assert {"e_v2x_bm[:pairwise]", "+episode[:pairwise]", "+step"} <= {*forms}
    assert not [form for form in forms if "estimated" in form or "robust" in form]


@pytest.mark.parametrize("setting", [{"allowance": 5.0}, {"logging": True}, {"shares": True}], ids=str)
def test_episode__takes_none_of_what_step_takes(setting: dict[str, object]) -> None:
    with refused("not a setting of mode episode; use mode step"):
        eb.ShieldOptions(mode="episode", **setting)


REFUSED: dict[str, Callable[[], object]] = {
    "unknown shield mode 'robust'; known: episode, step": lambda: eb.shield(
        eb.EthBrakeVectorEnv(2), mode="robust", uncertainty="gaps_m=0.2"
    ),
    "unknown ShieldedVectorEnv option 'uncertainty'; known: allowance, bound, cap": lambda: eb.shield(
        eb.EthBrakeVectorEnv(2), uncertainty="gaps_m=0.2"
    ),
    "unknown HybridShield option 'estimated'; known: allowance, bound, cap": lambda: eb.HybridShield(
        eb.parallel_env(), estimated=True
    ),
    "unknown shield option 'uncertainty'; known: allowance, bound, cap": lambda: eb.ShieldOptions(uncertainty="x=1"),
    "unknown shield or search 'robust'; known: episode, episode:pairwise, step": lambda: make_agent(
        "coast+robust", scenario=PAPER
    ),
    "unknown shield or search 'step:estimated'": lambda: make_agent("coast+step:estimated", scenario=PAPER),
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_an_extension_has__is_refused_in_one_line(message: str) -> None:
    with refused(message, UnknownName):
        REFUSED[message]()


def test_variant__of_an_agent_is_an_argument_that_it_does_not_take() -> None:
    with refused("agent 'e_v2x_bm:estimated': after the first colon, write 'coupled' or 'pairwise'"):
        make_agent("e_v2x_bm:estimated", scenario=PAPER)
