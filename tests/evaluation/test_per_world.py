from __future__ import annotations

import csv
import os
import stat
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.agents.registry import make_agent
from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.evaluation import Evaluation, evaluate, write_per_world
from ethbrake_marl.evaluation.measures import KNOWN_OF_WORLDS
from ethbrake_marl.files.store import check_target, write_output
from ethbrake_marl.scenario import Scenario


def read(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


def column(rows: list[dict[str, str]], name: str) -> np.ndarray:
    return np.array([float(row[name]) for row in rows])


def test_per_world__one_row_per_world_and_agent(tmp_path: Path, evaluation: Evaluation) -> None:
    write_per_world(tmp_path / "out.csv", evaluation)
    rows = read(tmp_path / "out.csv")
    assert [row["agent"] for row in rows] == [a for a in ("full_brake", "constant:4.5", "gap") for _ in range(200)]
    assert [int(row["world"]) for row in rows] == 3 * list(range(200))


def test_per_world__every_number_reads_back_as_the_same_bits(tmp_path: Path, evaluation: Evaluation) -> None:
    write_per_world(tmp_path / "out.csv", evaluation)
    rows = [row for row in read(tmp_path / "out.csv") if row["agent"] == "gap"]
    outcome, worlds = evaluation.outcome("gap"), evaluation.worlds
    expected = {
        "collided": outcome.collided,
        "impacts": outcome.impacts,
        "first_impact_harm": outcome.first_impact_harm,
        "total_harm": outcome.total_harm,
        "sampled_harm": outcome.sampled_harm,
        "vehicle_1_shoved_m": outcome.shoved_m,
        "predicted_harm": outcome.predicted_harm,
        "chosen_policy": outcome.chosen_policy,
        "end_s": outcome.final.time_s,
    }
    for i in range(3):
        expected[f"speed_{i + 1}_mps"] = worlds.speeds_mps[:, i]
        expected[f"final_speed_{i + 1}_mps"] = outcome.final.speeds_mps[:, i]
        expected[f"first_impact_harm_{i + 1}"] = outcome.vehicle_harm("first")[:, i]
        expected[f"total_harm_{i + 1}"] = outcome.vehicle_harm("total")[:, i]
    for p in range(2):
        expected[f"gap_{p + 1}_m"] = worlds.gaps_m[:, p]
        expected[f"final_gap_{p + 1}_m"] = outcome.final.gaps_m[:, p]
    for name, values in expected.items():
        np.testing.assert_array_equal(column(rows, name), values.astype(float), err_msg=name)
    assert {row["ended"] for row in rows} == {"at_rest"}
    assert set(rows[0]) == {"agent", "knows", "world", "hidden", "ended", *expected, *KNOWN_OF_WORLDS}


def test_per_world__the_initial_columns_make_the_same_worlds_again(tmp_path: Path, evaluation: Evaluation) -> None:
    write_per_world(tmp_path / "out.csv", evaluation)
    rows = [row for row in read(tmp_path / "out.csv") if row["agent"] == "full_brake"]
    names = ("gap_1_m", "gap_2_m", "speed_1_mps", "speed_2_mps", "speed_3_mps")
    worlds = evaluation.scenario.worlds_from_table({name: column(rows, name) for name in names})
    again = evaluate(worlds, {"b": make_agent("full_brake")}, scenario=evaluation.scenario).outcome("b")
    np.testing.assert_array_equal(again.total_harm, evaluation.outcome("full_brake").total_harm, strict=True)


def test_per_world__a_quantity_that_differs_between_worlds_has_its_columns(tmp_path: Path, pair: Scenario) -> None:
    columns = {"gap_1_m": [1.0, 1.0], "speed_1_mps": [20.0, 20.0], "speed_2_mps": [20.0, 20.0]}
    worlds = pair.worlds_from_table({**columns, "latency_2_s": [0.5, 0.25], "mass_1_t": [4.5, 4.5]})
    write_per_world(tmp_path / "out.csv", evaluate(worlds, {"b": make_agent("full_brake")}, scenario=pair))
    rows = read(tmp_path / "out.csv")
    assert [row["latency_2_s"] for row in rows] == ["0.5", "0.25"]
    assert [row["latency_1_s"] for row in rows] == ["0.0", "0.0"]
    assert "mass_1_t" not in rows[0]
    assert rows[0]["predicted_harm"] == rows[0]["chosen_policy"] == ""


def test_per_world__overwrites_only_by_force(tmp_path: Path, evaluation: Evaluation) -> None:
    path = tmp_path / "out.csv"
    path.write_text("mine")
    with pytest.raises(AlreadyExists, match="is there already"):
        write_per_world(path, evaluation)
    assert path.read_text() == "mine"
    write_per_world(path, evaluation, force=True)
    assert path.read_text().startswith("agent,world,gap_1_m")
    assert [file.name for file in tmp_path.iterdir()] == ["out.csv"]


def test_check_target__force_replaces_plain_files_only(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "mine").write_text("precious")
    (tmp_path / "link").symlink_to(tmp_path / "mine")
    (tmp_path / "dangling").symlink_to(tmp_path / "nothing")
    for name, message in (("pipe", "a device or a pipe"), ("link", "symbolic link"), ("dangling", "symbolic link")):
        for force in (False, True):
            with pytest.raises(InvalidInput, match=message):
                check_target(tmp_path / name, force=force)
    assert stat.S_ISFIFO((tmp_path / "pipe").lstat().st_mode)
    with pytest.raises(InvalidInput, match="a device or a pipe"):
        check_target("/dev/null", force=True)


def test_check_target__refuses_before_the_work_what_a_write_would_refuse(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match=r"out.csv: cannot be written \("):
        check_target("/proc/out.csv")
    with pytest.raises(InvalidInput, match=r"cannot be written \(File name too long\)"):
        check_target(tmp_path / ("a" * 300))
    assert list(tmp_path.iterdir()) == []


def test_write_output__takes_the_longest_name_there_is(tmp_path: Path) -> None:
    write_output(tmp_path / ("a" * 255), b"content")
    assert (tmp_path / ("a" * 255)).read_bytes() == b"content"


def test_check_target__refuses_a_folder_and_a_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(InvalidInput, match="is a folder"):
        check_target(tmp_path)
    with pytest.raises(InvalidInput, match="there is no folder"):
        check_target(tmp_path / "missing" / "out.csv", force=True)
    assert check_target(tmp_path / "new.csv") == tmp_path / "new.csv"
