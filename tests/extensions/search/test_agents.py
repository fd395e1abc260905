"""Agents that search, and searches around other agents, keep what every agent keeps."""

from pathlib import Path

import pytest

import ethbrake_marl.first_edition as eb
from ethbrake_marl.extensions.search.around import Searched
from ethbrake_marl.first_edition.agents.protocol import policy_sha256
from ethbrake_marl.first_edition.agents.spec import AgentSpec, parse_spec
from ethbrake_marl.first_edition.evaluation.lineup import make_lineup
from ethbrake_marl.first_edition.shields.drivers import ShieldedDriver
from ethbrake_marl.first_edition.shields.paper_hybrid import HybridAgent
from tests.first_edition.agents.test_drive import check_holds, check_rows
from tests.first_edition.agents.test_policy import check_bound, check_file, train_ppo
from tests.first_edition.engine.test_engine import check_restore, with_script
from tests.first_edition.evaluation.test_rollout import check_left_out, left_out_by
from tests.first_edition.physics.test_pieces import check_predicted
from tests.first_edition.scenario.test_sampling import check_obstacles_apart

PAPER = eb.load_scenario("paper-random")


@pytest.mark.parametrize(
    ("spec", "parts"),
    [
        ("ppo+search+step", AgentSpec("ppo", None, None, ("search", "step"))),
        ("mine:x@path+step", AgentSpec("mine", "x", "path", ("step",))),
    ],
)
def test_spec__is_taken_apart_and_written_again(spec, parts):
    assert parse_spec(spec) == parts and str(parts) == spec


@pytest.mark.parametrize(
    ("spec", "kind"),
    [
        ("best_harm:20+search", Searched),
        ("e_v2x_bm+search+episode", HybridAgent),
        ("ppo+search+step", ShieldedDriver),
        ("full_brake+search+step", ShieldedDriver),
    ],
)
def test_shields__go_around_any_agent_and_hold(spec, kind):
    check_holds(spec, kind)


@pytest.mark.parametrize("spec", ["best_harm:20", "constant:5+search"])
def test_agents__every_row_is_its_own_new_episodes_change_theirs_alone_and_agents_can_be_pickled(spec):
    check_rows(spec)


@pytest.fixture(scope="module")
def model():
    return train_ppo()


@pytest.mark.parametrize("around", ["+search", "+search+step"])
@pytest.mark.parametrize("kind", ["model", "function with a memory"])
def test_policy__behind_every_shield_keeps_the_bound(kind, model, around):
    check_bound(kind, model, around)


@pytest.mark.parametrize("around", ["+search", "+search+step"])
def test_file__makes_an_agent_alone_and_behind_every_shield(tmp_path: Path, around):
    check_file(tmp_path, around)


@pytest.mark.parametrize("before", [0, 45])
def test_restore__the_next_steps_are_the_same_to_the_bit(before: int) -> None:
    check_restore(with_script("best_harm:20"), "harm", before)


def test_mixture__an_obstacle_in_some_worlds_changes_nothing_in_the_others() -> None:
    check_obstacles_apart("best_harm:20", "full_brake+search")


@pytest.mark.parametrize("agent", ["best_harm:300", "coast+search"])
def test_predictions__are_what_is_done(agent: str) -> None:
    """Search is told the pieces of a script at the alert: what it expects is what is done."""
    check_predicted(agent)


def test_policy_sha256__is_found_inside_what_is_around_it() -> None:
    agent = eb.make_agent("ppo+search+episode", scenario=PAPER)
    assert policy_sha256(agent) == eb.load_shipped("ppo").manifest.manifest_sha256


def test_left_out__worlds_are_named_and_left_out_for_all_agents() -> None:
    check_left_out(left_out_by("best_harm:50"))


def test_lineup__of_the_ladder_is_every_rung() -> None:
    rungs = ["coast", "full_brake", "e_v2x_bm:pairwise", "e_v2x_bm", "best_harm"]
    assert list(make_lineup(["ladder", "constant:5"], PAPER)) == [*rungs, "constant:5"]
