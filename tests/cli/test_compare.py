"""Two results on the same worlds, and what is refused."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import ttest_ind

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.results import compare_results, read_result
from ethbrake_marl.evaluation.statistics import mean, paired_difference, unpaired_difference
from ethbrake_marl.files import plugins
from ethbrake_marl.files.sheet import Estimate


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Results on the same worlds, and one on others; not to be changed."""
    folder = tmp_path_factory.mktemp("results")
    asked = {
        "a": ("full_brake,coast", "40", "7"),
        "b": ("full_brake,e_v2x_bm", "40", "7"),
        "c": ("full_brake,coast", "40", "8"),
    }
    for name, (agents, episodes, seed) in asked.items():
        options = ("--agents", agents, "--episodes", episodes, "--seed", seed)
        assert run_command(["evaluate", *options, "--per-world", str(folder / f"{name}.csv")]) == 0
    content = json.loads((folder / "b.csv.json").read_text())
    for row in content:  # what another policy of the same name would have left
        row["agent"] = {"e_v2x_bm": "coast"}.get(row["agent"], row["agent"])
    data = (folder / "b.csv").read_text().replace("\ne_v2x_bm,", "\ncoast,")
    (folder / "d.csv").write_text(data)
    beside = {"file": "d.csv", "sha256": hashlib.sha256(data.encode()).hexdigest()}
    (folder / "d.csv.json").write_text(json.dumps([row | {"per_world": beside} for row in content]))
    (folder / "alone.json").write_text(
        json.dumps([{k: v for k, v in row.items() if k != "per_world"} for row in content])
    )
    return folder


def test_same_agents__differ_by_nothing(results: Path) -> None:
    found = compare_results(read_result(results / "a.csv.json"), read_result(results / "b.csv.json"))
    (only,) = found.differences
    assert only.agent == "full_brake" and only.policy == "none" and found.unpaired_because is None
    assert only.harms == dict.fromkeys(("first_impact_harm", "total_harm"), Estimate(0.0, (0.0, 0.0)))
    assert found.left_over == (("coast",), ("e_v2x_bm",)) and found.other_versions == {}


def test_difference__is_paired_by_world_where_every_world_is_there(results: Path) -> None:
    paired = compare_results(read_result(results / "a.csv.json"), read_result(results / "d.csv.json"))
    apart = compare_results(read_result(results / "a.csv.json"), read_result(results / "alone.json"))
    columns = {}
    for name in ("a", "d"):
        rows = np.genfromtxt(results / f"{name}.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
        columns[name] = rows["total_harm"][rows["agent"] == "coast"]
    assert paired.differences[1].harms["total_harm"] == paired_difference(columns["d"], columns["a"])
    both = [found.differences[1].harms["total_harm"].value for found in (paired, apart)]
    assert both[0] == pytest.approx(both[1])
    assert paired.to_json()["intervals"] == "paired" and apart.to_json()["intervals"] == "unpaired"
    assert "alone.json has none" in str(apart.unpaired_because)


def test_edited_worlds__are_not_paired(results: Path, tmp_path: Path) -> None:
    for name in ("a.csv.json", "d.csv.json", "a.csv"):
        (tmp_path / name).write_bytes((results / name).read_bytes())
    missing = compare_results(read_result(tmp_path / "a.csv.json"), read_result(tmp_path / "d.csv.json"))
    assert "d.csv is not there" in str(missing.unpaired_because)
    (tmp_path / "d.csv").write_bytes((results / "d.csv").read_bytes().replace(b"\ncoast,1,", b"\ncoast,2,"))
    edited = compare_results(read_result(tmp_path / "a.csv.json"), read_result(tmp_path / "d.csv.json"))
    assert "d.csv is not the one that was written with" in str(edited.unpaired_because)


def test_other_worlds_or_scenarios__are_refused_in_one_line(results: Path, tmp_path: Path) -> None:
    first = read_result(results / "a.csv.json")
    with pytest.raises(InvalidInput, match=r"c.csv.json: is about another list of worlds than .*: no comparison$"):
        compare_results(first, read_result(results / "c.csv.json"))
    rows = [row | {"scenario_sha256": "0" * 64} for row in json.loads((results / "a.csv.json").read_text())]
    (tmp_path / "other.json").write_text(json.dumps(rows))
    with pytest.raises(InvalidInput, match="is about another scenario than"):
        compare_results(first, read_result(tmp_path / "other.json"))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("[", "is no JSON"),
        ("{}", "is no results file"),
        ("3", "is no results file"),
        ("[]", "is no results file"),
        ("[1]", "is no results file"),
        ('[{"kind": "evaluate", "agent": "full_br', "is no JSON, or was not written to its end"),
        ('[{"kind": "evalute"}]', "unknown kind of results 'evalute'; did you mean 'evaluate'"),
        ('[{"agent": "x", "episodes": 3}]', r"\(kind is missing\)"),
        ('{"kind": "best-harm"}', "results of best-harm cannot be compared; those of evaluate, shield"),
        ('{"kind": "evaluate-shards", "seed": 7}', "agents is missing or no list of objects"),
        ('[{"kind": "evaluate", "agent": "x", "episodes": 3}]', "worlds_sha256 is missing or no str: evaluate again"),
    ],
)
def test_read_result__refuses_what_is_no_result(tmp_path: Path, text: str, reason: str) -> None:
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(InvalidInput, match=f"x.json: .*{reason}"):
        read_result(tmp_path / "x.json")


@pytest.mark.parametrize(
    "change",
    [
        {"total_harm": "x"},
        {"total_harm": None},
        {"total_harm": True},
        {"total_harm_interval": [1]},
        {"total_harm_interval": [1e6, 2e6]},
        {"total_harm_interval": [9, 1]},
        {"total_harm": 1e300},
        {"total_harm": 10**400},
        {"total_harm": -5.0, "total_harm_interval": [-6, 1]},
        {"episodes": 1},
        {"episodes": 0},
        {"episodes": 10**30},
        {"episodes": True},
    ],
)
def test_read_result__refuses_means_that_are_none(results: Path, tmp_path: Path, change: dict[str, Any]) -> None:
    rows = [row | change for row in json.loads((results / "alone.json").read_text())]
    (tmp_path / "x.json").write_text(json.dumps(rows))
    with pytest.raises(InvalidInput, match=r"x\.json: full_brake: .*(is no mean with an interval|episodes = )"):
        read_result(tmp_path / "x.json")


def test_read_result__refuses_an_agent_that_stands_in_it_twice(results: Path, tmp_path: Path) -> None:
    rows = json.loads((results / "alone.json").read_text())
    (tmp_path / "x.json").write_text(json.dumps([*rows, rows[0]]))
    with pytest.raises(InvalidInput, match=r"x\.json: full_brake stands in it twice"):
        read_result(tmp_path / "x.json")


def test_compare__refuses_a_mean_that_is_not_that_of_its_worlds(results: Path, tmp_path: Path) -> None:
    rows = json.loads((results / "a.csv.json").read_text())
    rows[0] |= {"first_impact_harm": 3.0, "first_impact_harm_interval": [2.0, 4.0]}
    (tmp_path / "a.csv.json").write_text(json.dumps(rows))
    (tmp_path / "a.csv").write_bytes((results / "a.csv").read_bytes())
    with pytest.raises(InvalidInput, match=r"first_impact_harm = 3, but the mean of its worlds is \d"):
        compare_results(read_result(results / "a.csv.json"), read_result(tmp_path / "a.csv.json"))


def test_unpaired_difference__is_welchs() -> None:
    draw = np.random.default_rng(3)
    one, other = draw.normal(5.0, 2.0, 30), draw.normal(4.0, 1.0, 50)
    found = unpaired_difference(mean(one), 30, mean(other), 50)
    low, high = ttest_ind(one, other, equal_var=False).confidence_interval(0.95)
    assert found.interval == pytest.approx((low, high), rel=1e-12)


def test_compare__prints_the_differences_and_says_which_intervals(ethbrake: Callable[..., Any], results: Path) -> None:
    answer = ethbrake("compare", results / "a.csv.json", results / "d.csv.json")
    assert answer.status == 0 and "coast" in answer.out and "paired by world" in answer.err
    told = json.loads(ethbrake("compare", results / "a.csv.json", results / "alone.json", "--json").out)
    assert told["intervals"] == "unpaired" and [each["agent"] for each in told["agents"]] == ["full_brake", "coast"]
    refused = ethbrake("compare", results / "a.csv.json", results / "c.csv.json")
    assert refused.status == 2 and refused.err.count("\n") == 1 and "another list of worlds" in refused.err


def test_compare__a_run_and_its_report_are_results_too(ethbrake: Callable[..., Any], finished_run: Path) -> None:
    results, other_tests = finished_run / "results.json", finished_run / "other_tests.json"
    told = json.loads(ethbrake("compare", results, results, "--json").out)
    assert told["intervals"] == "paired"
    assert {each["agent"]: each["policy"] for each in told["agents"]}["ppo"] == "same"
    assert all(each["total_harm_difference_interval"] == [0.0, 0.0] for each in told["agents"])
    assert "each test needs a file of its own" in ethbrake("compare", results, other_tests).err
    row = json.loads(results.read_text())[0]
    page = (finished_run / "report.html").read_text()
    assert row["worlds_sha256"] in page and row["scenario_sha256"] in page


def test_shield__is_compared_with_its_own_kind(ethbrake: Callable[..., Any], results: Path, tmp_path: Path) -> None:
    commands = {
        "shield": ("shield", "--agents", "full_brake", "--episodes", "5"),
        "total": ("shield", "--agents", "full_brake", "--episodes", "5", "--harm-count", "total"),
    }
    for name, command in commands.items():
        (tmp_path / f"{name}.json").write_text(ethbrake(*command, "--json").out)
    told = json.loads(ethbrake("compare", tmp_path / "shield.json", tmp_path / "shield.json", "--json").out)
    assert [each["agent"] for each in told["agents"]] == [
        f"full_brake ({mode})" for mode in ("none", "episode", "step", "step-alert")
    ]
    assert all(each["harm_difference"] == 0.0 for each in told["agents"])
    refused = ethbrake("compare", tmp_path / "shield.json", tmp_path / "total.json")
    assert (refused.status, refused.err.count("\n")) == (2, 1) and "is about another harm than" in refused.err
    refused = ethbrake("compare", tmp_path / "shield.json", results / "a.csv.json")
    assert (refused.status, refused.err.count("\n")) == (2, 1) and "is about another kind of results" in refused.err


@pytest.mark.slow
def test_compare__sees_that_an_agents_file_was_edited(results: Path, tmp_path: Path) -> None:
    """Each evaluation is a process of its own, as a person's two commands are."""
    file = tmp_path / "mine.py"
    program = "import sys; from ethbrake_marl.cli.app import run_command; sys.exit(run_command(sys.argv[1:]))"
    for name, deceleration in (("before", 2), ("after", 3)):
        file.write_text(
            f"import ethbrake_marl as eb\ndef make():\n    return eb.make_agent('constant:{deceleration}')\n"
        )
        answer = subprocess.run(
            [sys.executable, "-c", program, "evaluate", "--agents", f"{file}:make", "--episodes", "5", "--json"],
            env={**os.environ, "PYTHONPATH": os.getcwd()}, capture_output=True, text=True, check=True,
        )  # fmt: skip
        (tmp_path / f"{name}.json").write_text(answer.stdout)
    before, after = (read_result(tmp_path / f"{name}.json") for name in ("before", "after"))
    assert after.about["versions"]["mine.py"] == f"SHA-256 {hashlib.sha256(file.read_bytes()).hexdigest()}"
    assert set(compare_results(before, after).other_versions) == {"mine.py"}
    assert compare_results(after, after).other_versions == {}


def test_compare__tells_other_settings_of_the_agents_and_another_driven_vehicle(
    ethbrake: Callable[..., Any], tmp_path: Path
) -> None:
    line = ["evaluate", "--scenario", "paper-random", "--episodes", "5", "--json"]
    ways = {
        "first": ["--agents", "e_v2x_bm"],
        "total": ["--agents", "e_v2x_bm", "--harm-count", "total"],
        "front": ["--agents", "e_v2x_bm", "--vehicle", "vehicle_3"],
    }
    for name, more in ways.items():
        (tmp_path / f"{name}.json").write_text(ethbrake(*line, *more).out)
    told = ethbrake("compare", tmp_path / "first.json", tmp_path / "total.json")
    assert told.status == 0 and "note: harm_count first in the first, total in the second" in told.err
    found = compare_results(read_result(tmp_path / "first.json"), read_result(tmp_path / "total.json"))
    assert found.to_json()["other_settings"] == {"harm_count": ["first", "total"]}
    other = ethbrake("compare", tmp_path / "first.json", tmp_path / "front.json")
    assert other.status == 2 and "is about another driven vehicle than" in other.err


def test_weights_of_another_library__have_a_hash_and_a_file_behind_the_at_is_told(
    ethbrake: Callable[..., Any], tmp_path: Path
) -> None:
    (tmp_path / "mine.py").write_text(
        "import numpy as np, ethbrake_marl as eb\n"
        "def make(argument, settings):\n"
        "    share = np.load(settings.policy)[0]\n"
        "    return eb.policy_agent(lambda seen: np.full((len(seen), 1), share), scenario=settings.scenario)\n"
    )
    line = ["evaluate", "--episodes", "5", "--json", "--agents", f"{tmp_path}/mine.py:make@{tmp_path}/w.npy"]
    rows = []
    for share in (-1.0, -0.2):
        np.save(tmp_path / "w.npy", [share])
        plugins._READ.clear()
        rows += json.loads(ethbrake(*line).out)
    one, other = (row["versions"]["w.npy"] for row in rows)
    assert one.startswith("SHA-256 ") and one != other
