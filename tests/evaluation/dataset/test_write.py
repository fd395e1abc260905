"""What ``eb.write_dataset`` refuses before its work, and a world that fails."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl as eb
from ethbrake_marl.errors import AlreadyExists, InvalidInput, MissingExtra, PhysicsError
from ethbrake_marl.evaluation import episodes
from ethbrake_marl.evaluation.episodes import Recording
from tests.contract.interfaces import PAPER

BRAKE = {"full_brake": eb.make_agent("full_brake")}
PAIR = eb.load_scenario("cooperation-3-pair")
NOBODY = PAPER.replace(roles={f"vehicle_{i}": "full_brake" for i in (1, 2, 3)})


@pytest.fixture(autouse=True)
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(episodes, "need", lambda package: None)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"episodes": 0}, "episodes = 0: must be a whole number"),
        ({"seed": -1}, "seed = -1: must be a whole number"),
        ({"agents": {}}, "no agents given"),
        ({"format": "csv"}, "unknown format 'csv'"),
        ({"format": "minari"}, r"the format minari is written to a folder called NAME-vNUMBER"),
        ({"path": "a-v0", "format": "parquet"}, r"the format parquet is written to a file ending in .parquet"),
        ({"path": "brakes"}, "a folder called NAME-vNUMBER, for instance brakes-v0"),
        ({"path": "nowhere/a.parquet"}, "there is no folder nowhere"),
        ({"path": "nowhere/a-v0"}, "there is no folder nowhere"),
        ({"scenario": NOBODY}, "has no learner to record; say who is driven: --vehicle vehicle_2"),
        ({"scenario": NOBODY, "path": "a-v0"}, "has no learner to record"),
        (
            {"scenario": PAIR, "path": "a-v0"},
            r"2 learners \(vehicle_2, vehicle_3\); a dataset of Minari is one learner's",
        ),
    ],
)
def test_write__refuses_before_its_work(
    settings: Mapping[str, Any], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    given = {"path": "a.parquet", "agents": BRAKE, "scenario": PAPER, "episodes": 2, **settings}
    with pytest.raises(InvalidInput, match=message):
        eb.write_dataset(given.pop("path"), given.pop("agents"), **given)
    assert list(tmp_path.iterdir()) == []


def test_check__replaces_nothing_unasked_and_only_datasets_when_asked(tmp_path: Path) -> None:
    (tmp_path / "a.parquet").write_text("")
    (tmp_path / "a-v0").mkdir()
    for name in ("a.parquet", "a-v0"):
        with pytest.raises(AlreadyExists, match=r"use force \(--force\)"):
            episodes.check_dataset(tmp_path / name, PAPER)
    assert episodes.check_dataset(tmp_path / "a.parquet", PAPER, force=True) == "parquet"
    with pytest.raises(InvalidInput, match="is no dataset of Minari, and is not replaced"):
        episodes.check_dataset(tmp_path / "a-v0", PAPER, force=True)


def test_write__without_the_extra_names_the_line_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    for package in ("pyarrow", "minari", "h5py"):
        monkeypatch.setitem(sys.modules, package, None)
    for name, package in (("a.parquet", "pyarrow"), ("a-v0", "minari")):
        with pytest.raises(
            MissingExtra, match=rf"{package}, which is not installed: .* install 'ethbrake-marl\[data\]'"
        ):
            eb.write_dataset(tmp_path / name, BRAKE, scenario=PAPER, episodes=1)
    assert list(tmp_path.iterdir()) == []


def test_work__leaves_a_failed_world_out_and_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorded: list[Recording] = []
    real = episodes.record_episodes

    def failing(sample: Any, *rest: Any) -> Recording:
        bad = {row: "planted" for row, number in enumerate(sample.index) if number == 4}
        if bad:
            raise PhysicsError(bad)
        return real(sample, *rest)

    monkeypatch.setattr(episodes, "record_episodes", failing)
    monkeypatch.setattr(episodes, "BATCH", 3)
    monkeypatch.setattr(episodes, "parquet_dataset", lambda path, told: nullcontext(recorded.append))
    seen: list[tuple[str, int]] = []
    work = eb.write_dataset(
        tmp_path / "some.parquet", BRAKE, scenario=PAPER, episodes=7, on_progress=lambda *done: seen.append(done)
    )
    assert [each.index.tolist() for each in recorded] == [[0, 1, 2], [3, 5], [6]]
    assert seen == [("full_brake", 3), ("full_brake", 6), ("full_brake", 7)]
    ((world, seed, agent, reason),) = work.left_out
    assert (world, seed, agent, reason) == (4, 7, "full_brake", "planted")
    assert work.episodes == {"full_brake": 6}
