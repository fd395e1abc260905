"""Drivers behind one step shield, world by world."""

from __future__ import annotations

import numpy as np

from ethbrake_marl.agents.registry import Team, drive, make_agent
from ethbrake_marl.scenario import Task, load_scenario
from ethbrake_marl.shield import ShieldedDriver, guard as behind_module
from ethbrake_marl.shield.guard import Shielded, put_shield

PAIR, PAPER = (load_scenario(name) for name in ("cooperation-3-pair", "paper-random"))


def test_drive_chunks__is_what_the_shielded_team_does_whatever_the_chunk(monkeypatch):
    worlds, task = PAIR.sample(12, 7).worlds, Task(PAIR, (1, 2), "total")
    team = ShieldedDriver(Team.of(make_agent("coast"), (1, 2)), PAIR, harm_count="total", logging=True)
    episodes = drive(worlds, team.on((1, 2)), PAIR)
    ledger, shield = episodes.ledger, episodes.guarded.shield
    whole = Shielded.driven(make_agent("coast"), worlds, task)
    assert whole.harm.tolist() == ledger.world_harm("total").tolist()
    assert whole.vehicle_harm.tolist() == ledger.vehicle_harm("total").tolist()
    assert whole.bound.tolist() == shield.predicted_harm.tolist() and (whole.harm <= whole.bound).all()
    assert whole.baseline.tolist() == shield.baseline_shares.tolist()
    logged = np.zeros((12, 2), np.int64)
    for entry in shield.log:
        logged[entry.world, entry.vehicle - 1] += 1
    assert whole.replaced.tolist() == logged.tolist() and (logged.sum(axis=0) > 0).all()
    assert (whole.replaced <= whole.decisions[:, np.newaxis]).all()
    monkeypatch.setattr(behind_module, "CHUNK", 5)
    parts = Shielded.driven(make_agent("coast"), worlds, task)
    assert all(np.array_equal(*columns) for columns in zip(whole, parts, strict=True))
    assert Shielded.stack([whole, parts]).replaced.shape == (2, 12, 2)


def test_put_shield__of_one_learner_it_is_the_shield_of_one():
    task = Task(PAPER, (1,), "first")
    behind = put_shield(Team({1: make_agent("full_brake")}, "one"), task, allowance=2.0)
    assert list(behind.drivers) == [1] and behind.name == "full_brake+step"
    worlds = PAPER.sample(20, 3).worlds
    found = Shielded.driven(make_agent("full_brake"), worlds, task, allowance=2.0)
    assert found.replaced.shape == (20, 1) and found.baseline.shape == (20, 3)
    alone = drive(worlds, make_agent("full_brake+step", scenario=PAPER), PAPER, 1).ledger.world_harm("first")
    assert (found.harm <= found.bound).all() and (found.bound > alone).all()
