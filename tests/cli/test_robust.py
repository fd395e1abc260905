"""The robust shield on the command line."""

from __future__ import annotations

import json

import pytest

from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.scenario import load_scenario
from ethbrake_marl.shield import ShieldedDriver, parse_uncertainty

PNG = b"\x89PNG\r\n\x1a\n"


def test_evaluate__the_robust_shield_goes_around_any_agent(ethbrake):
    agents = "ppo@shipped+robust,full_brake+robust"
    options = ("--agents", agents, "--uncertainty", "gaps_m=0.5", "--episodes", "8", "--json")
    answer = ethbrake("evaluate", *options)
    assert answer.status == 0
    rows = json.loads(answer.out)
    assert [row["agent"] for row in rows] == ["ppo@shipped+robust", "full_brake+robust"]


def test_lineup__robust_agents_certify_against_the_uncertainty():
    intervals = parse_uncertainty("gaps_m=0.5")
    lineup = make_lineup(["ppo@shipped+robust"], load_scenario("paper-random"), uncertainty=intervals)
    agent = lineup["ppo@shipped+robust"]
    assert isinstance(agent, ShieldedDriver) and agent.name == "ppo@shipped+robust"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--agents", "ppo@shipped+robust"), "agent 'ppo@shipped+robust': mode robust needs an uncertainty"),
        (("--agents", "coast", "--uncertainty", "gaps_m=1"), "nobody uses it"),
        (("--agents", "ppo@shipped+robust", "--uncertainty", "gap=1"), "unknown uncertain quantity"),
        (("--agents", "ppo@shipped+robust", "--uncertainty", "mass_t=9"), "it must stay above 0"),
        (
            ("--agents", "ppo@shipped+robust", "--uncertainty", "latency_s=1000"),
            "uncertainty: latency_s=1000: vehicle_2 may decide first at 1000.5 s; must be before the horizon, 8 s",
        ),
    ],
)
def test_evaluate__what_does_not_fit_is_one_line(ethbrake, options, message):
    answer = ethbrake("evaluate", "--episodes", "5", *options)
    assert (answer.status, answer.out) == (2, "")
    assert message in answer.err and len(answer.err.strip().splitlines()) == 1


def test_picture__is_drawn_and_its_figures_are_told(ethbrake, tmp_path):
    out = tmp_path / "robust.png"
    options = ("--uncertainty", "gaps_m.pair_1=1", "--episodes", "4", "--output", out, "--json")
    answer = ethbrake("watch", "picture", "robustness", *options)
    assert answer.status == 0 and out.read_bytes().startswith(PNG)
    told = json.loads(answer.out)
    assert len(told) == 5 * 3 * 2 and {row["mode"] for row in told} == {"step", "robust"}
    assert ethbrake("watch", "picture", "robustness", *options).status == 2
    assert ethbrake("watch", "picture", "robustness", "--output", tmp_path / "robust.docx").status == 2
