"""What each mode of the shield makes of an agent: the same figures as driving it by hand, in one table."""

import pytest

from ethbrake_marl.first_edition.agents.driving import drive
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.agents.protocol import Team
from ethbrake_marl.first_edition.evaluation.shield_modes import ShieldModes, compare_modes
from ethbrake_marl.first_edition.evaluation.statistics import paired_difference
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.task import Task
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver
from ethbrake_marl.first_edition.shields.evidence import review
from ethbrake_marl.first_edition.shields.paper_hybrid import HybridAgent

PAPER, PAIR = (load_scenario(name) for name in ("paper-random", "cooperation-3-pair"))
WORLDS = PAPER.sample(60, 3).worlds
BRAKE = {"full_brake": make_agent("full_brake")}


@pytest.fixture(scope="module")
def rows() -> ShieldModes:
    return compare_modes(BRAKE, WORLDS, Task(PAPER, (1,)))


def test_rows__are_what_driving_each_mode_gives(rows: ShieldModes) -> None:
    agent = BRAKE["full_brake"]
    drivers = (agent, HybridAgent(agent, PAPER), ShieldedDriver(agent, PAPER))
    driven = [drive(WORLDS, driver, PAPER, 1) for driver in drivers]
    harms = [episodes.ledger.world_harm("first") for episodes in driven]
    assert [row.mode for row in rows] == ["none", "episode", "step", "step-alert"]
    assert [row.harm.value for row in rows[:3]] == [harm.mean() for harm in harms]
    assert rows[0].against_episode == paired_difference(harms[0], harms[1])
    assert rows[1].against_episode is None and rows[1].replaced is None
    shield = driven[2].guarded.shield
    assert rows[2].replaced == shield.interventions.sum() / shield.memory.running.steps.sum() > 0.1
    for row in rows[2:]:  # what the interventions were good for
        told = row.to_json()
        assert sum(row.verdicts) == pytest.approx(1.0) and told["needed"] == row.verdicts[0] > 0.9
        assert row.above_bound == 0 and told["against_episode_interval"][1] < 0.0


def test_rows__do_not_depend_on_the_size_of_a_chunk(rows: ShieldModes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ethbrake_marl.first_edition.evaluation.shield_modes.CHUNK", 25)
    done: list[tuple[str, int]] = []
    assert compare_modes(BRAKE, WORLDS, Task(PAPER, (1,)), on_progress=lambda *a: done.append(a)) == rows
    assert done == [("full_brake", 25), ("full_brake", 50), ("full_brake", 60)]


def test_team__an_intervention_is_simulated_again_without_it_for_the_whole_team() -> None:
    worlds = PAIR.sample(40, 3).worlds
    coasting = Team.of(make_agent("coast"), (1, 2))
    episodes = drive(worlds, ShieldedDriver(coasting, PAIR, logging=True).on((1, 2)), PAIR)
    harm = episodes.ledger.world_harm("first")
    found = review(episodes.guarded.shield, coasting, worlds)
    assert found.harm.tolist() == harm[found.world].tolist() and set(found.vehicle) == {1, 2}
    alone = drive(worlds, Team.of(make_agent("coast"), (1, 2)), PAIR).ledger.world_harm("first")
    first = {world: k for k, world in reversed(list(enumerate(found.world.tolist())))}
    assert all(found.unshielded_harm[k] == alone[world] for world, k in first.items()) and len(first) > 20
    assert found.share("needed") > 0.5


def test_team__what_is_behind_a_shield_is_compared_without_it() -> None:
    worlds, task = PAIR.sample(5, 3).worlds, Task(PAIR, (1, 2))
    agents = {name: make_agent(name, scenario=PAIR) for name in ("full_brake", "coast+step")}
    assert {row.agent for row in compare_modes(agents, worlds, task, behind=True)} == {"coast"}
