"""Every interface in the modes of this extension: what the core's tests ask of its own modes."""

from typing import Any

import numpy as np
import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.certified.robust_step import RobustShield
from ethbrake_marl.extensions.certified.uncertainty import parse_uncertainty
from ethbrake_marl.first_edition.agents.driving import episode_engine
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.evaluation.shield_modes import compare_modes
from ethbrake_marl.first_edition.scenario.task import Task
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver
from tests.first_edition.evaluation.test_shield_modes import WORLDS
from tests.first_edition.shield import test_wrappers as wrappers
from tests.first_edition.shield.attacks import line
from tests.first_edition.shield.test_guard import PAPER, Counting, asks_once, drives_off, remembering
from tests.first_edition.shield.test_infos import INTERFACES, belonging
from tests.first_edition.shield.test_step_shield import begins_apart, coasts

MODES: dict[str, tuple[int, dict[str, Any]]] = {
    "robust": (2, {"uncertainty": "gaps_m=0.2"}),
    "estimated": (1, {"estimated": True}),
}


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("interface", INTERFACES)
def test_infos__of_the_first_moment_and_of_the_last_belong_to_their_episode(interface: str, mode: str) -> None:
    code, options = MODES[mode]
    for first, last in belonging(interface, code, options):
        assert first["shield_reason"] == eb.ShieldReason.NO_DECISION != last["shield_reason"]


@pytest.mark.parametrize("interface", [*wrappers.MAKERS, eb.shield])
def test_interfaces__are_robust_where_an_uncertainty_is_given(interface: Any) -> None:
    env = interface(wrappers.MAKERS.get(interface, eb.EthBrakeEnv)(), uncertainty="gaps_m=0.5")
    assert env.attached.options.mode == "robust"
    env.attached.close()


@pytest.mark.parametrize("interface", wrappers.MAKERS)
def test_interfaces__have_mode_robust_and_the_penalty(interface: Any) -> None:
    wrappers.pays(interface, {"mode": "robust", "uncertainty": "gaps_m=0.2", "harm_count": "total"}, 2)


@pytest.mark.parametrize("policy", [eb.policy_agent(remembering, initial_state=lambda n: np.zeros((n, 1))), Counting()])
def test_policy_with_a_memory__is_asked_once_per_decision_whoever_proposes(policy: Any) -> None:
    asks_once({"mode": "step", "estimated": True}, policy)


@pytest.mark.parametrize(
    ("intervals", "steps"),
    [
        ("gaps_m=2", 3),  # 13 m in the worst corner
        ("braking_capacity_mps2.vehicle_2=20%", 2),  # 12.5 m to stop with 4 m/s2: 2.5 m
        ("speeds_mps.vehicle_2=2", 0),  # 12 m/s: 14.4 m to stop; 0.6 m is half a step
        ("mass_t=50%", 5),  # changes nothing before an impact
    ],
)
def test_by_hand__coasting_is_let_through_as_long_as_the_worst_corner_can_still_stop(
    intervals: str, steps: int
) -> None:
    coasts(0.0, steps, parse_uncertainty(intervals).members)


def test_begin__of_some_rows_leaves_the_others_alone() -> None:
    begins_apart(line(3), RobustShield, uncertainty=parse_uncertainty("gaps_m.pair_1=0.5"))


def test_world__that_goes_on_after_the_shields_own_end_is_braked_fully():
    worlds = PAPER.sample(40, 7).worlds
    slower = parse_uncertainty("braking_capacity_mps2=20%").draw(worlds, np.random.default_rng(0), corners=True)
    engine = episode_engine(
        worlds, ShieldedDriver(drives_off, PAPER, assumed=slower, uncertainty="gaps_m=0.02"), PAPER, 1
    )
    braking, after = -worlds.vehicles.braking_capacity_mps2[:, 1], np.zeros(40, bool)
    while not engine.ended.all():
        over = engine.guarded.shield.memory.running.finished & ~engine.ended
        engine.step({})
        assert (engine.wanted_mps2[over, 1] == braking[over]).all()
        after |= over
    assert 0 < after.sum() < 40


def test_behind_shields__those_that_do_not_know_the_world_are_left_out() -> None:
    agent = make_agent("full_brake+robust", scenario=PAPER, uncertainty="gaps_m=0.5")
    assert compare_modes({"it": agent}, WORLDS, Task(PAPER, (1,)), behind=True) == []
