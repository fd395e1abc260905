"""``ethbrake evaluate``, ``compare`` and ``shield``: what they leave."""

import hashlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import ttest_ind

import ethbrake_marl.first_edition as eb
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.files.sheet import Estimate
from ethbrake_marl.first_edition.agents import registry
from ethbrake_marl.first_edition.agents.making import make_agent
from ethbrake_marl.first_edition.agents.protocol import Team
from ethbrake_marl.first_edition.agents.registry import Entry
from ethbrake_marl.first_edition.evaluation.comparison import compare_results
from ethbrake_marl.first_edition.evaluation.lineup import make_lineup
from ethbrake_marl.first_edition.evaluation.per_world import read_result, write_per_world
from ethbrake_marl.first_edition.evaluation.statistics import mean, paired_difference, unpaired_difference
from ethbrake_marl.first_edition.scenario.catalogue import load_scenario
from ethbrake_marl.first_edition.scenario.tables import read_worlds
from tests.fixtures.commands import Command, check_refused, rows_of, told_json

SCENARIO = load_scenario("paper-random")


def test_evaluate__the_harm_count_is_what_agents_lower(ethbrake: Command) -> None:
    arguments = ("evaluate", "--episodes", "200", "--agents", "e_v2x_bm", "--json", "--set")
    (first,), (total,) = (told_json(ethbrake(*arguments, f"harm_count={count}")) for count in ("first", "total"))
    assert total["total_harm"] < first["total_harm"] and total["first_impact_harm"] > first["first_impact_harm"]


def test_evaluate__a_world_computed_by_hand(tmp_path: Path) -> None:
    # Vehicle 2 at 10 m/s coasts 5 m in its 0.5 s and brakes the last 3 m with 7 m/s2 towards a standing Vehicle 1:
    # closing speed squared 10^2 - 2 * 7 * 3 = 58. Vehicle 3 stands 5 km behind. In the second world nobody moves.
    own, out = tmp_path / "mine.csv", tmp_path / "worlds.csv"
    own.write_text("gap_1_m,gap_2_m,speed_1_mps,speed_2_mps,speed_3_mps,restitution\n8,5000,0,10,0,0\n8,5000,0,0,0,0\n")
    found = eb.evaluate(read_worlds(SCENARIO, own), "full_brake", scenario=SCENARIO)
    (row,) = eb.summarise(found)
    told = row.episodes, row.collision_rate.value, row.first_impact_harm.value
    assert told == (2, 0.5, pytest.approx(29.0, rel=1e-12))
    write_per_world(out, found)
    columns = ("total_harm", "collided", "impacts", "final_gap_1_m")
    hit, still = ([float(each[name]) for name in columns] for each in rows_of(out))
    assert hit[:3] == [pytest.approx(58.0, rel=1e-12), 1.0, 1.0] and still == [0.0, 0.0, 0.0, 8.0]


def test_standards__full_braking_passes_as_published_and_is_struck_by_a_follower(ethbrake: Command) -> None:
    words = ("evaluate", "--scenario", "standards", "--agents", "full_brake,e_v2x_bm", "--episodes", "200")
    alone = told_json(ethbrake(*words, "--json"))
    followed = told_json(ethbrake(*words, "--set", "follower={time_gap_s: 0.6}", "--json"))
    assert len(alone) == len(followed) == 14 and {row["worlds"] for row in alone + followed} == {200}
    for row in alone + followed:
        struck = row["agent"] == "full_brake" and row in followed
        assert row["passed"] == (row["collision_rate"] == row["hardest_impact_kmh"] == 0.0) == (not struck)
        assert (row["total_harm"] > 5.0) == struck
    # by hand: both at 60 km/h, Vehicle 2 stands after 0.2 s and v^2 / 18; that and 10 m Vehicle 3 has after its 0.75 s
    hardest = next(row for row in followed if row["scenario"] == "standards-r157")["hardest_impact_kmh"]
    speed = 16.667
    way = 0.6 * speed + 0.2 * speed + speed**2 / 18.0 - 0.75 * speed
    assert hardest == pytest.approx(3.6 * (speed**2 - 2.0 * 7.59 * way) ** 0.5, rel=1e-6)
    refused = ethbrake(*words, "--jobs", "2")
    assert (
        refused.status == 2
        and "--jobs: cannot be used with standards, a group of 7 scenarios; name a single scenario" in refused.err
    )


def test_evaluate__one_agent_that_cannot_drive_is_refused_before_another_works(ethbrake, monkeypatch) -> None:
    monkeypatch.setattr(
        "ethbrake_marl.first_edition.evaluation.chunks.evaluate_held", lambda *args, **kwargs: pytest.fail("worked")
    )
    refused = ethbrake("evaluate", "--agents", "e_v2x_bm,constant:99", "--episodes", "5")
    check_refused(refused, "agent 'constant:99': brakes harder than the braking capacity of 7 m/s2")


# Lists of agents and worlds


def test_lineup__a_team_goes_behind_the_step_shield_and_no_other(monkeypatch) -> None:
    scenario, team = load_scenario("cooperation-3-pair"), Team.of(make_agent("coast"), [1, 2])
    monkeypatch.setitem(
        registry.AGENTS.loaded, "team", Entry("team", "team@RUN", "", (), lambda argument, settings: team)
    )
    assert sorted(make_lineup(["team@run+step"], scenario)["team@run+step"].drivers) == [1, 2]
    with pytest.raises(
        InvalidInput, match=r"'team@run\+episode': \+episode works for one controlled vehicle only, not for a team"
    ):
        make_lineup(["team@run+episode"], scenario)


# Evaluations in several processes, and their folder


@pytest.mark.long
def test_evaluate__on_ray_and_in_processes_prints_the_same(ethbrake: Command, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    line = ("evaluate", "--agents", "full_brake,e_v2x_bm:pairwise", "--episodes", "6000", "--json")
    here = ethbrake(*line)
    for more in (("--jobs", "2"), ("--ray", "local", "--jobs", "2")):
        found = ethbrake(*line, *more, "--output", tmp_path / more[0])
        assert found.status == 0 and found.out == here.out == (tmp_path / more[0] / "results.json").read_text()


# Two results


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results on the same worlds; d is b as another policy of the name coast left it; not to be changed."""
    folder = tmp_path_factory.mktemp("results")
    for name, agents in (("a", "full_brake,coast"), ("b", "full_brake,e_v2x_bm")):
        options = ("--agents", agents, "--episodes", "40", "--output", str(folder / name), "--per-world", "csv")
        assert run_command(["evaluate", *options]) == 0
    content = json.loads((folder / "b/results.json").read_text().replace('"agent": "e_v2x_bm"', '"agent": "coast"'))
    data = (folder / "b/worlds.csv").read_text().replace("\ne_v2x_bm,", "\ncoast,")
    (folder / "d").mkdir()
    (folder / "d/worlds.csv").write_text(data)
    beside = {"file": "worlds.csv", "sha256": hashlib.sha256(data.encode()).hexdigest()}
    (folder / "d/results.json").write_text(json.dumps([row | {"per_world": beside} for row in content]))
    alone = [{key: value for key, value in row.items() if key != "per_world"} for row in content]
    (folder / "alone.json").write_text(json.dumps(alone))
    return folder


def test_compare__difference_is_paired_by_world_where_every_world_is_there(results: Path) -> None:
    first = read_result(results / "a/results.json")
    paired, apart = (compare_results(first, read_result(results / name)) for name in ("d/results.json", "alone.json"))
    columns = [
        np.array(
            [float(row["total_harm"]) for row in rows_of(results / name / "worlds.csv") if row["agent"] == "coast"]
        )
        for name in "da"
    ]
    assert paired.differences[1].harms["total_harm"] == paired_difference(*columns)
    assert paired.differences[0].harms == dict.fromkeys(("first_impact_harm", "total_harm"), Estimate(0.0, (0.0, 0.0)))
    both = [found.differences[1].harms["total_harm"].value for found in (paired, apart)]
    assert both[0] == pytest.approx(both[1])
    assert [found.to_json()["intervals"] for found in (paired, apart)] == ["paired", "unpaired"]
    assert "alone.json was written without a file that has one row" in str(apart.unpaired_because)


def test_compare__unpaired_interval_is_welchs() -> None:
    draw = np.random.default_rng(3)
    one, other = draw.normal(5.0, 2.0, 30), draw.normal(4.0, 1.0, 50)
    found = unpaired_difference(mean(one), 30, mean(other), 50)
    expected = ttest_ind(one, other, equal_var=False).confidence_interval(0.95)
    assert found.interval == pytest.approx(tuple(expected), rel=1e-12)


# ---------------------------------------------------------------- files, shields


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


# What an extra brings


@pytest.mark.parametrize(
    ("package", "extra", "line"),
    [
        ("pyarrow", "data", "evaluate --agents coast --episodes 2 --output new --per-world parquet"),
        ("onnx", "export", "agent export ppo --onnx policy.onnx"),
    ],
)
def test_file__of_an_extra_that_is_missing_says_the_line_that_installs_it(
    ethbrake: Command, package: str, extra: str, line: str, monkeypatch
) -> None:
    check_extra(ethbrake, package, extra, line, monkeypatch)


def check_extra(ethbrake: Command, package: str, extra: str, line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    missing = f"needs the package {package}, which is not installed; install it with: {sys.executable} -m pip install"
    check_refused(ethbrake(*line.split()), f"{missing} 'ethbrake-marl[{extra}]'\n")
    assert list(Path().iterdir()) == []


# Shields


def test_evaluate__deletes_the_files_of_earlier_results_and_nothing_else(ethbrake: Command, tmp_path: Path) -> None:
    line = ("evaluate", "--agents", "coast", "--episodes", "2", "--output", tmp_path / "out", "--force")
    assert ethbrake(*line, "--per-world", "csv").status == 0
    (tmp_path / "out" / "notes.txt").write_text("mine")
    assert ethbrake(*line).status == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"results.json", "notes.txt"}
