"""The trial of a scenario: what its worlds are like, and whom a learner knows."""

from __future__ import annotations

import pytest

from ethbrake_marl.agent_names import AGENTS
from ethbrake_marl.cli.trial import COMPARED, WORLDS, try_scenario
from ethbrake_marl.worlds.catalogue import load_scenario

PAPER = load_scenario("paper-random")


def test_trial__tells_harm_and_whom_the_learner_knows():
    trial = try_scenario(PAPER)
    assert trial.drawn.worlds.n == WORLDS and (trial.early, trial.moving, trial.late) == (0, 0, 0)
    assert trial.known == {"vehicle_2": {"vehicle_1": 1.0, "vehicle_3": 1.0}}
    assert round(trial.harm["full braking"]["first"], 2) == 21.74


def test_trial__tells_what_a_blocked_channel_hides():
    (known,) = try_scenario(load_scenario("cooperation-2-blocked")).known.values()
    assert known["vehicle_1"] == 1.0 and 0.5 < known["vehicle_3"] < 0.75


def test_trial__counts_what_moves_what_is_late_and_what_collides_early(monkeypatch):
    monkeypatch.delitem(COMPARED, "best known")  # a search, if it is installed
    trial = try_scenario(PAPER.replace(horizon_s=1.0))
    assert trial.moving == WORLDS
    assert try_scenario(PAPER.replace(latency_s=[0.1, 0.5, 0.8])).late == WORLDS
    near = PAPER.replace(early_impacts="keep", gaps_m=[0.05, 9.0], speeds_mps=[15.0, 22.0, 20.0])
    assert try_scenario(near).early == WORLDS


def test_trial__of_a_line_that_nobody_learns_in_has_no_harm_to_compare():
    trial = try_scenario(PAPER.with_learners([]))
    assert trial.harm == {} and trial.known == {} and trial.moving == 0


@pytest.mark.skipif("best_harm" not in AGENTS, reason="the search is an extension")
def test_best_known__is_told_of_one_learner_alone() -> None:
    assert "best known" in try_scenario(PAPER).harm
    assert [*try_scenario(load_scenario("cooperation-3-pair")).harm] == ["full braking", "best constant deceleration"]
