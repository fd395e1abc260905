"""The scripts of ``train/benchmark``: table, cross-play, offline data, and methods that learn."""

from __future__ import annotations

import re
import runpy
import sys
from importlib.util import find_spec
from inspect import signature
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ethbrake_marl as eb
from ethbrake_marl.agent_names import teams_of
from ethbrake_marl.errors import InvalidInput
from ethbrake_marl.evaluation.benchmark import benchmark_rows, evaluate_task
from ethbrake_marl.extensions.report.style import picture_bytes
from ethbrake_marl.files.sheet import csv_text
from tests.docs.site import load
from tests.fixtures.commands import Command, rows_of, told_json
from tests.refused import refused

FOLDER = Path(__file__).resolve().parents[2] / "train" / "benchmark"
table = load(FOLDER / "table")
run = load(FOLDER / "run")
cross_play = load("cross_play")
data = load("offline_data")
PNG = b"\x89PNG"
SCALE = {"honest_cost": "30", "best_known_honest": "10", "sees_through_channel": "False"}
MEANS = dict.fromkeys(table.MEANS, "1")
IDENTITY = {"worlds_sha256": "a", "physics_digest": "b"}


def rows_file(path: Path, *rows: dict[str, Any]) -> Path:
    written = [{"task": "t", **SCALE, **MEANS, **IDENTITY, **row} for row in rows]
    shares = [{table.SHARE: (30 - float(row["honest_cost"])) / 20} for row in written]
    path.write_text(csv_text([share | row for share, row in zip(shares, written, strict=True)]))
    return path


MINE = """
import ethbrake_marl as eb


def make_agent(argument, settings):
    return eb.make_agent("constant:5")
"""


def test_benchmark__prints_a_row_for_each_task_and_writes_it(ethbrake: Command, empty_folder: Path) -> None:
    Path("mine.py").write_text(MINE)
    words = ("evaluate", "--scenario", "benchmark", "--episodes", "40", "--output", "new")
    agents = "full_brake,e_v2x_bm,mine.py:make_agent"
    printed = told_json(ethbrake(*words, "--agents", agents, "--json"))
    written = rows_of(Path("new/rows.csv"))
    names = [(row["task"], row["agent"]) for row in written]
    assert names == [(row["task"], row["agent"]) for row in printed] and len({*names}) == 7 * 3
    for text, row in zip(written, printed, strict=True):
        result = eb.read_result(f"new/{row['task']}/results.json")[row["agent"]]
        for key in ("honest_cost", "worst5_honest", "maximin_honest", "pushed_mps", "collision_rate"):
            assert float(text[key]) == row[key] == result[key]
        assert text["worlds_sha256"] == result["worlds_sha256"] and row["version"] == eb.__version__
        assert row["share_of_possible_reduction_honest"] == 0.0 or row["agent"] != "full_brake"
    chosen = [row["honest_cost"] for row in printed if row["agent"] == "e_v2x_bm"]
    again = told_json(ethbrake("evaluate", "--scenario", "cooperation-4-all", "--episodes", "40", "--agents",
                               "e_v2x_bm", "--json"))  # fmt: skip
    assert again[0]["honest_cost"] == chosen[0]  # by default agents minimise the honest cost
    shown = ethbrake(*words, "--agents", "coast", "--force").out
    assert "benchmark-truck" in shown and "Possible" in shown


@pytest.mark.parametrize("other", ["--seed 8"])
def test_benchmark__in_worlds_without_a_best_known_cost_has_no_share(
    ethbrake: Command, empty_folder: Path, other: str
) -> None:
    words = "evaluate --scenario benchmark-pair --agents full_brake --json --output new --episodes 20"
    [row] = told_json(ethbrake(*words.split(), *other.split()))
    [written] = rows_of(Path("new/rows.csv"))
    assert written[table.SHARE] == "" and float(written["worst5_honest"]) == row["worst5_honest"] > 0.0
    with refused("has no share of the possible reduction"):
        table.read_rows([Path("new/rows.csv")])


def test_table__shows_the_middle_three_of_five_seeds_on_the_scale(tmp_path: Path) -> None:
    # without the best and the worst seed: mean 46 / 3; (30 - 46 / 3) / (30 - 10) = 73.3 %
    seeds = [
        {"agent": "m", "method": "m", "seed": k, "decisions": 200, "cpu_s": 10 * k, "honest_cost": cost}
        for k, cost in enumerate((11, 20, 15, 99, 10))
    ]
    rules = rows_file(
        tmp_path / "rules.csv",
        {"agent": "full_brake"},
        {"agent": "omniscient", "honest_cost": "12"} | {"sees_through_channel": "True"},
    )
    cells = table.read_rows([rules, rows_file(tmp_path / "m.csv", *seeds)])
    first, second, last, best = table.table(cells)
    names = ["omniscient †", "m", "full_brake", "best known (search)"]
    assert [row["method"] for row in (first, second, last, best)] == names
    assert [second[key] for key in ("seeds", "decisions", "CPU s")] == ["5", "200", "20"]
    assert second["share of the possible"].startswith("73.3 % [") and second["honest cost"].startswith("15.33 [")
    assert [row["share of the possible"] for row in (first, last, best)] == ["90.0 %", "0.0 %", "100.0 %"]
    assert best["honest cost"] == "10.00" and best.keys() == second.keys()
    [rows] = table.overviews(cells)
    shares = {row["method"]: row["t"] for row in rows}
    assert shares["m"] == second["share of the possible"] and shares["omniscient"] == "90.0 % †"
    assert shares["full braking, honest cost"] == "30.00"
    figure = tmp_path / "figure.png"
    table.write_picture(figure, table.draw(cells), force=True)
    assert figure.read_bytes().startswith(PNG)


def test_table__refuses_rows_of_other_worlds_and_rows_without_a_share(tmp_path: Path) -> None:
    mine = {"agent": "m"}
    for name, value in (("worlds_sha256", "c"), ("physics_digest", "c"), ("best_known_honest", "11")):
        files = [rows_file(tmp_path / "a.csv", mine), rows_file(tmp_path / "b.csv", {"agent": "n", name: value})]
        with refused(f"b.csv: t, n: {name} = {value}, but "):
            table.read_rows(files)
    with refused("a.csv: t, m: has no share of the possible reduction; evaluate full_brake beside it"):
        table.read_rows([rows_file(tmp_path / "a.csv", {**mine, table.SHARE: ""})])


def test_table__refuses_what_must_not_be_one_row(tmp_path: Path) -> None:
    first = {"agent": "m", "seed": 0, "decisions": 200}
    for change, message in (
        ({}, "another row has the same seed"),
        ({"seed": "00"}, "another row has the same seed"),
        ({"seed": 1, "sees_through_channel": "True"}, "sees_through_channel = True, but False in another row"),
        ({"seed": 1, "decisions": 900}, "decisions = 900, but 200 in another row"),
        ({"seed": 1, "version": "0.1.0"}, "version = 0.1.0, but"),
    ):
        files = [rows_file(tmp_path / "a.csv", first), rows_file(tmp_path / "b.csv", {**first, **change})]
        with refused(message):
            table.read_rows(files)
    (tmp_path / "c.csv").write_text("task,harm\nt,1\n")
    with refused("c.csv: lacks the column worlds_sha256; must have rows of run.py or of evaluate"):
        table.read_rows([tmp_path / "c.csv"])
    with refused("no rows"):
        table.read_rows([])


@pytest.mark.parametrize(
    ("name", "value", "right"),
    [
        (table.SHARE, "nan", "a finite number"),
        ("seed", "0.5", "a whole number"),
        ("method", "a|b", "a name without |"),
        ("sees_through_channel", "true", "True or False"),
    ],
)
def test_table__refuses_a_value(tmp_path: Path, name: str, value: str, right: str) -> None:
    row = {table.SHARE: "0.5", "task": "t", "agent": "m", **SCALE, **MEANS, **IDENTITY}
    (tmp_path / "a.csv").write_text(csv_text([{**row, name: value}]))
    with refused(f": {name} = {value!r}: must be {right}"):
        table.read_rows([tmp_path / "a.csv"])


def test_differences__of_two_methods_and_of_two_tasks_by_hand(tmp_path: Path) -> None:
    costs = {("pair", "mappo"): (10, 12, 11), ("pair", "ippo"): (20, 20, 20), ("blocked", "ippo"): (23, 23, 23)}
    rows = [
        {"task": f"benchmark-{task}", "agent": method, "seed": seed, "honest_cost": cost}
        for (task, method), seeds in costs.items()
        for seed, cost in enumerate(seeds)
    ]
    central, blocked = table.differences(table.read_rows([rows_file(tmp_path / "m.csv", *rows)]))
    assert (central["cell"], central["minus"]) == ("benchmark-pair, mappo", "benchmark-pair, ippo")
    assert central["honest cost"] == "-9.00 [-10.00, -8.00]"
    assert blocked["cell"] == "benchmark-blocked, ippo" and blocked["honest cost"] == "3.00 [3.00, 3.00]"


def test_further_training__lies_in_the_interval_of_student() -> None:
    # mean 3, deviation sqrt(2.5), t = 2.776 with 4 degrees of freedom: 3 +- 2.776 sqrt(2.5) sqrt(1.2) = 3 +- 4.81
    assert table.further([0.01, 0.02, 0.03, 0.04, 0.05]) == "3.0 % [-1.8, 7.8]"
    assert table.further([0.5, 0.6]) == ""


def test_improvement__is_the_share_of_pairs_that_are_better(tmp_path: Path) -> None:
    costs = {"m": (10, 14, 16), "n": (15, 16, 20)}  # 3 + 3 + 1.5 of 9 pairs
    rows = [
        {"agent": method, "seed": seed, "decisions": 100, "simulated": factor * 100, "honest_cost": cost}
        for factor, (method, seeds) in enumerate(costs.items(), 1)
        for seed, cost in enumerate(seeds)
    ]
    cells = table.read_rows([rows_file(tmp_path / "m.csv", *rows)])
    better, last, _ = (row.get("better than the next") for row in table.table(cells))
    assert better.startswith("83.3 % [") and last == ""
    assert [row["simulated"] for row in table.overviews(cells)[0]] == ["1", "2", "", ""]


def test_rows__of_a_task_have_the_shares_of_the_shipped_table(tmp_path: Path) -> None:
    result = evaluate_task(eb.load_scenario("benchmark-pair"), "full_brake,constant:6", episodes=40)
    rows = benchmark_rows({"benchmark-pair": eb.summarise(result)}, method="")
    true = [row[table.SHARE] for row in rows]
    for best, row in enumerate(rows, 1):  # of two versions of the shipped table
        (tmp_path / f"{best}.csv").write_text(csv_text([{**row, table.SHARE: 0.5, "best_known_honest": best}]))
    cells = table.read_rows(tmp_path.glob("*.csv"))
    read = [float(cells["benchmark-pair", name][0][table.SHARE]) for name in ("full_brake", "constant:6")]
    assert read == pytest.approx(true) and abs(true[1]) > 0.01


def test_held_out_list__has_a_seed_that_depends_on_trials_and_costs(tmp_path: Path) -> None:
    (tmp_path / "trials").mkdir()
    row = {"task": "benchmark-pair", "agent": "m", "method": "m", "seed": "0", "honest_cost": "2"}
    seeds = []
    for trials, cost in (("a", "2"), ("b", "2"), ("b", "3"), ("b", "3")):
        (tmp_path / "trials" / "m.csv").write_text(trials)
        (tmp_path / "m.csv").write_text(csv_text([{**row, "honest_cost": cost}]))
        seeds.append(run.held_out_seed(tmp_path, "m"))
    assert len({*seeds}) == 3 and seeds[2] == seeds[3]
    full = {"task": "benchmark-pair", "agent": "full_brake", "method": "full_brake", "list_seed": "9"}
    (tmp_path / "second.csv").write_text(csv_text([{**full, "honest_cost": "10"}, {**row, "list_seed": "9"}]))
    cells = {("benchmark-pair", "m"): [{"honest_cost": "3"}], ("benchmark-pair", "full_brake"): [{"honest_cost": "4"}]}
    [saved] = table.held_out(cells, [tmp_path / "second.csv"])
    assert [*saved.values()] == ["m", "25.0 %", "80.0 %", "9"]


def test_held_out_rows__are_of_the_lists_that_follow_from_trials_and_rows() -> None:
    files = [*(table.ROWS / "held_out").glob("*.csv")]
    assert len(files) >= 3
    for file in files:
        assert {row["list_seed"] for row in rows_of(file)} == {f"{run.held_out_seed(table.ROWS, file.stem)}"}


def test_methods__have_the_settings_of_their_best_trials() -> None:
    trials = [*(table.ROWS / "trials").glob("*.csv")]
    assert len(trials) >= 3 and len({len(rows_of(file)) for file in trials}) == 1
    for file in trials:
        best = min(rows_of(file), key=lambda row: float(row["harm"]))
        path, function = run.METHODS[file.stem].rsplit(":", 1)
        if file.stem not in ("ippo", "mappo", "iql") or find_spec("benchmarl"):
            known = signature(getattr(load(Path(path).with_suffix("")), function)).parameters
            for name, value in best.items():
                if name not in ("trial", "harm"):
                    assert known[name].default == pytest.approx(float(value), rel=0.01), (file.stem, name)


def test_cross_play__has_the_means_on_and_off_the_diagonal() -> None:
    on, off = cross_play.summary(np.array([[1.0, 5.0, 6.0], [5.0, 1.0, 4.0], [6.0, 4.0, 1.0]]))
    assert on.in_words() == "1.00 [1.00, 1.00]"
    assert off.in_words() == "5.00 [4.00, 6.00]"  # a sample has two teams or three


def test_tables__on_the_page_and_in_a_file_are_those_of_the_committed_rows() -> None:
    results = FOLDER.parents[1] / "docs" / "results"
    page, cells = (results / "benchmark.md").read_text("utf-8"), table.read_rows(table.ROWS.glob("*.csv"))
    overviews = table.overviews(cells)
    assert len(overviews) == 2 and all(table.text_of(rows) in page for rows in overviews)
    assert table.text_of(table.held_out(cells, (table.ROWS / "held_out").glob("*.csv"))) in page
    assert csv_text(table.table(cells)) == (results / "benchmark.csv").read_text("utf-8")
    tables = [*overviews, table.table(cells), table.differences(cells)]
    values = {value for rows in tables for row in rows for value in row.values()}
    for path, begin, end in (
        (results / "benchmark.md", "## Results\n", "\n| "),
        (results.parent / "findings.md", "## Which method learns best", "\n## "),
    ):
        text = " ".join(path.read_text("utf-8").partition(begin)[2].partition(end)[0].split())
        said = re.findall(r"-?\d+\.\d+(?: %)? \[[^]]*\]", text)
        assert len(said) >= 3 and {*said} <= values


@pytest.mark.usefixtures("pinned_matplotlib")
def test_figure__is_drawn_from_the_committed_rows() -> None:
    made = table.draw(table.read_rows(table.ROWS.glob("*.csv")))
    shown = FOLDER.parents[1] / "docs" / "figures" / "benchmark.png"
    assert picture_bytes(made, "made.png") == shown.read_bytes()


def test_cross_play__of_two_teams_by_hand() -> None:
    names, cost = cross_play.cross_play("benchmark-pair", ["full_brake", "constant:5"])
    assert names == ["full_brake", "constant:5"] and cost.shape == (2, 2)
    drivers = {"vehicle_2": "full_brake", "vehicle_3": "constant:5"}
    mixed = eb.evaluate("benchmark-pair", {"mixed": drivers}, episodes=2000)["mixed"]["honest_cost"]
    assert cost[0, 1] == mixed.mean()
    with refused("needs two agents or more, and two learners or more"):
        cross_play.cross_play("benchmark-single", ["full_brake", "constant:5"])


def run_script(monkeypatch: pytest.MonkeyPatch, path: Path, *words: str) -> None:
    monkeypatch.setattr(sys, "argv", [path.name, *words])
    runpy.run_path(str(path), run_name="__main__")


@pytest.mark.parametrize("word", ["--csv", "--figure"])
def test_file__that_cannot_be_written_is_refused_before_the_work(
    empty_folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, word: str
) -> None:
    with pytest.raises(SystemExit, match="2"):
        run_script(monkeypatch, FOLDER / "table.py", word, "none/x.png")
    out, err = capsys.readouterr()
    assert out == "" and "the folder none does not exist; create it first" in err


def test_data__of_a_task_has_the_same_digest_twice(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pandas = pytest.importorskip("pandas")
    for name in ("one", "two"):
        words = "benchmark-all", str(tmp_path / f"{name}.parquet"), "--episodes", "3"
        run_script(monkeypatch, Path(data.__file__), *words)
    one, two = (line.rpartition(" ")[2] for line in capsys.readouterr().out.splitlines())
    assert one == two == data.digest(pandas.read_parquet(tmp_path / "one.parquet"))


def test_data__replays_bit_for_bit_in_an_environment() -> None:
    reward = {"harm": 1.0, "jerk": 0.1}
    scenario, game = eb.open_game("cooperation-3-pair", reward=reward)
    team = teams_of("e_v2x_bm", scenario)["e_v2x_bm"]
    rows = iter(data.recorded(game, scenario.sample(4, data.SEED), team).to_dict("records"))
    env = eb.parallel_env(scenario=scenario, reward=reward)
    for world in range(4):
        seen, infos = env.reset(options={"listed_world": {"seed": data.SEED, "number": world}})
        decision = 0
        while env.agents:
            row, actions = next(rows), {}
            assert (row["agent"], row["world"], row["decision"]) == ("e_v2x_bm", world, decision)
            assert row["time_s"] == infos["vehicle_1"]["time_s"]
            assert [row[f"speed_{i}_mps"] for i in (1, 2, 3)] == env.episode.speeds_mps[0].tolist()
            assert [row[f"gap_{p}_m"] for p in (1, 2)] == env.episode.gaps_m[0].tolist()
            for i in scenario.learners:
                observed = [value for name, value in row.items() if name.startswith(f"observation_{i}.")]
                assert np.array_equal(np.array(observed, np.float32), seen[f"vehicle_{i}"])
                actions[f"vehicle_{i}"] = np.array([row[f"action_{i}"]], np.float32)
            seen, rewards, terminated, truncated, infos = env.step(actions)
            for i in scenario.learners:
                recorded = row[f"reward_{i}"], row["terminated"], row["truncated"]
                assert recorded == tuple(each[f"vehicle_{i}"] for each in (rewards, terminated, truncated))
            decision += 1
    assert next(rows, None) is None


METHODS = [("sb3", "ppo"), ("sb3", "sac"), ("clone", "clone"), ("marl", "ippo"), ("marl", "mappo"), ("marl", "iql")]
METHODS += [("vine", "cooperation")]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("file", "method"), METHODS)
def test_method__saves_what_its_agent_drives(file: str, method: str, tmp_path: Path) -> None:
    if file == "marl" and find_spec("benchmarl") is None:
        pytest.skip("needs the extra marl")
    module, task = load(FOLDER / file), eb.load_scenario("benchmark-pair")
    told = getattr(module, method)(task, 0, 5_000, tmp_path)
    assert told["start"] and (told.get("simulated", 5_000) > 50_000) == (file in ("clone", "vine"))
    agents = {"full_brake": "full_brake", "mine": f"{FOLDER / file}.py:make_agent:{tmp_path}"}
    result = evaluate_task(task, agents, episodes=50)
    rows = benchmark_rows({"benchmark-pair": eb.summarise(result)}, method=method)
    assert rows[1]["method"] == method and rows[1]["share_of_possible_reduction_honest"] < 1.0
    assert (result["mine"]["honest_cost"] != result["full_brake"]["honest_cost"]).any()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_marl__trains_three_learners_to_the_last_decision(tmp_path: Path) -> None:
    pytest.importorskip("benchmarl", reason="needs the extra marl")
    task = eb.load_scenario("benchmark-all")
    load(FOLDER / "marl").ippo(task, 0, 8_400, tmp_path)  # 64 / 3 is no whole number of steps
    assert (tmp_path / "policy.pt").exists()


def test_marl__needs_several_learners(tmp_path: Path) -> None:
    pytest.importorskip("benchmarl", reason="needs the extra marl")
    with pytest.raises(InvalidInput, match="has one learner"):
        load(FOLDER / "marl").ippo(eb.load_scenario("benchmark-single"), 0, 100, tmp_path)
