"""V2X presets and objectives from the user's own file: in scenarios, in trainings, in tables, in the schema."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agents.policy import LearnedAgent
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.harm import declared_objectives
from ethbrake_marl.learning.runs import train
from ethbrake_marl.policies import load_policy
from ethbrake_marl.scenario import scenario_json_schema
from ethbrake_marl.scenario.v2x import CHANNELS
from tests.learning.tiny import TINY_PPO

SCENARIO = eb.load_scenario("paper-random")
MINE = '''
import numpy as np
import ethbrake_marl as eb


def front_first(harm, vehicle):
    """The harm of the front vehicle and of the own."""
    return harm.borne[:, 0] + harm.borne[:, vehicle]


eb.register_preset("rural", {"preset": "nominal", "lost": 0.3, "message_period_s": 0.2})
eb.register_objective("front-first", front_first)
'''


@pytest.fixture
def mine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    (tmp_path / "my_parts.py").write_text(MINE)
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("my_parts")
    sys.modules.pop("my_parts")


def test_preset__is_drawn_and_trained_with_like_the_mapping_that_it_stands_for(mine: Any, tmp_path: Path) -> None:
    written = {"preset": "nominal", "lost": 0.3, "message_period_s": 0.2}
    rural, spelt = (SCENARIO.replace(v2x=v2x, horizon_s=20, early_impacts="keep") for v2x in ("rural", written))
    assert rural.v2x.channel == spelt.v2x.channel != CHANNELS["nominal"]
    one, other = (scenario.sample(20, 3).worlds.vehicles for scenario in (rural, spelt))
    assert one.latency_s.tobytes() == other.latency_s.tobytes()
    result = train(TINY_PPO.replace(total_steps=1024), rural, tmp_path / "run", measure=None)
    assert load_policy(result.directory).manifest.scenario["v2x"]["preset"] == "rural"
    folder = tmp_path / "rural.yaml"
    folder.write_text(json.dumps(json.loads(rural.replace(name="rural").model_dump_json(exclude_unset=True))))
    assert eb.load_scenario(folder).v2x == rural.v2x
    assert rural.replace(v2x={"preset": "rural", "lost": 0.0}).v2x.channel.message_period_s == 0.2


def test_objective__trains_and_stands_in_tables(mine: Any, tmp_path: Path) -> None:
    scenario = SCENARIO.replace(objective="front-first")
    policy = load_policy(train(TINY_PPO.replace(total_steps=1024), scenario, tmp_path / "run", measure=None).directory)
    found = eb.evaluate(scenario.sample(10, 7), {"mine": LearnedAgent(policy, "mine")}, scenario=scenario)
    assert declared_objectives(["standard"], 3)[-1] == "front-first"
    (row,) = (row for row in found.rescore() if (row.objective, row.harm_count) == ("front-first", "total"))
    borne = found.outcome("mine").ledger.vehicle_harm("total").mean(axis=0)
    assert [each.value for each in row.each] == pytest.approx(borne + borne[0])
    env = eb.parallel_env(scenario=SCENARIO, reward={"harm": 1.0, "objective": "front-first"})
    env.reset(seed=2)
    totals = dict.fromkeys(env.agents, 0.0)
    while env.agents:
        _, rewards, _, _, infos = env.step({agent: np.zeros(1, np.float32) for agent in env.agents})
        totals = {agent: totals[agent] + rewards[agent] for agent in totals}
    harms = [infos[agent]["first_impact_harm"] for agent in totals]
    assert harms[0] > 0.0
    assert list(totals.values()) == pytest.approx([-(harms[0] + harm) for harm in harms])


def test_schema__knows_what_is_registered(mine: Any) -> None:
    schema = scenario_json_schema()
    assert "rural" in json.dumps(schema["properties"]["v2x"]) + json.dumps(schema.get("$defs", {}))
    assert "front-first" in json.dumps(schema["properties"]["objective"])


@pytest.mark.parametrize(
    ("name", "settings", "error", "message"),
    [
        ("nominal", {"lost": 0.1, "preset": "clear"}, AlreadyExists, "preset 'nominal' is registered already"),
        ("My preset", {}, InvalidInput, "preset 'My preset': must be 1 to 64 of a-z"),
        ("mine", {"preset": "ruarl"}, InvalidInput, "preset 'mine': preset = ruarl: must be paper, .* or sensors-only"),
        ("mine", {"los": 1}, InvalidInput, "preset 'mine': los: unknown key; did you mean lost"),
        (
            "mine",
            {"preset": "clear", "lost": 2.0},
            InvalidInput,
            "preset 'mine': lost = 2(.0)?: must be less than or equal",
        ),
        ("mine", {"loss_begins": 0.1}, InvalidInput, "preset 'mine': loss_begins = 0.1: preset paper has no generated"),
        ("mine", "clear", InvalidInput, "settings = 'clear': must be a mapping"),
    ],
)
def test_register_preset__refuses_what_cannot_be_used(name: str, settings: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=message):
        eb.register_preset(name, settings)
    assert "mine" not in CHANNELS


def test_preset__with_a_fixed_latency_takes_no_settings_of_messages() -> None:
    eb.register_preset("wired", {"preset": "nominal", "link_latency_s": 0.4})
    eb.register_preset("wired", {"preset": "nominal", "link_latency_s": 0.4})
    assert SCENARIO.replace(v2x="wired", horizon_s=20, early_impacts="keep").v2x.channel.timing == "fixed"
    with pytest.raises(InvalidInput, match=r"radio_s = 0.1: a fixed link_latency_s has no generated messages"):
        SCENARIO.replace(v2x={"preset": "wired", "radio_s": 0.1})
    with pytest.raises(InvalidInput, match=r"v2x.preset = wierd: must be paper, .*sensors-only or wired"):
        SCENARIO.replace(v2x="wierd")


def flat(harm: Any, vehicle: int) -> Any:
    """One number for all."""
    return 1.0


def emptied(harm: Any, vehicle: int) -> Any:
    """Everybody's harm, after a slip that would change the ledger for all who come later."""
    harm.borne[:] = 0.0
    return harm.whole


def broken(harm: Any, vehicle: int) -> Any:
    """Not a number."""
    return np.full(len(harm.whole), np.nan)


def test_objective__of_another_shape_or_not_finite_is_named(mine: Any) -> None:
    for name, function, message in (
        ("flat", flat, r"objective 'flat': gave float64 of shape \(\); must be numbers of shape \(1,\)"),
        ("broken", broken, "objective 'broken': is nan for vehicle_1 in world 0; must be finite"),
        ("emptied", emptied, "objective 'emptied': of vehicle_1: ValueError: .*read-only"),
    ):
        eb.register_objective(name, function)
        env = eb.parallel_env(scenario=SCENARIO, reward={"harm": 1.0, "objective": name})
        with pytest.raises(InvalidInput, match=message):
            env.reset(seed=1)
            env.step({agent: np.zeros(1, np.float32) for agent in env.agents})
    with pytest.raises(InvalidInput, match="unknown objective 'frontfirst'; did you mean 'front-first'"):
        SCENARIO.replace(objective="frontfirst")
    with pytest.raises(InvalidInput, match="front-first takes no argument"):
        SCENARIO.replace(objective="front-first:3")


@pytest.mark.parametrize(
    ("name", "function", "error", "message"),
    [
        ("own", flat, AlreadyExists, "objective 'own' is registered already"),
        ("Mine", flat, InvalidInput, "objective 'Mine': must be 1 to 64 of a-z"),
        ("mine", 3, InvalidInput, "objective 'mine': needs a function with a docstring"),
        ("mine", lambda harm, vehicle: harm.whole, InvalidInput, "needs a function with a docstring"),
    ],
)
def test_register_objective__refuses_what_cannot_be_used(name: str, function: Any, error: Any, message: str) -> None:
    with pytest.raises(error, match=message):
        eb.register_objective(name, function)
