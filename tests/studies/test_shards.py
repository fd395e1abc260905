"""The folder of a sharded evaluation: what is finished is kept, what is damaged or foreign is refused."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from multiprocessing import active_children
from pathlib import Path

import numpy as np
import pytest

from ethbrake_marl.errors import AlreadyExists, InvalidInput
from ethbrake_marl.evaluation.measures import Tally
from ethbrake_marl.evaluation.results import Question
from ethbrake_marl.scenario import Scenario
from ethbrake_marl.studies.jobs import LocalWorkers, evaluate_shards

N = 4_500


@pytest.fixture(scope="module")
def asked(paper_random: Scenario) -> Question:
    return Question(paper_random, ("full_brake", "coast"), N, 11).ask()


@pytest.fixture(scope="module")
def tally(asked: Question) -> Tally:
    return evaluate_shards(asked, shards=1)


@pytest.fixture
def driven(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int]]:
    """The ranges of worlds that are driven from now on."""
    found: list[tuple[int, int]] = []
    answer = Question.answer

    def noted(asked, first, end, *more):
        found.append((first, end))
        return answer(asked, first, end, *more)

    monkeypatch.setattr(Question, "answer", noted)
    return found


def finished(folder: Path) -> int:
    """How many shards the folder keeps."""
    journal = folder / "journal.jsonl"
    return journal.read_text().count('"status": "finished"') if journal.exists() else 0


def interrupted(asked: Question, folder: Path, after: int, shards: int, **more) -> None:
    """Let an evaluation be killed when so many shards are finished."""

    def tell(progress) -> None:
        if finished(folder) == after:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate_shards(asked, shards=shards, folder=folder, tell=tell, **more)


def test_killed__goes_on_with_what_is_left(asked, tally, driven, tmp_path: Path) -> None:
    folder = tmp_path / "kept"
    interrupted(asked, folder, 2, shards=4)
    assert driven == [(0, 1_000), (1_000, 2_000)]
    driven.clear()
    assert evaluate_shards(asked, shards=4, folder=folder) == tally
    assert driven == [(2_000, 3_000), (3_000, 4_500)]
    driven.clear()
    assert evaluate_shards(asked, shards=4, folder=folder) == tally
    assert driven == []
    with pytest.raises(InvalidInput, match="shards 4, here 3"):
        evaluate_shards(asked, shards=3, folder=folder)


@pytest.mark.slow
def test_processes__give_the_same_tally_and_a_shard_whose_process_was_killed_is_driven_again(
    asked, tally, tmp_path: Path
) -> None:
    folder, told = tmp_path / "kept", []

    class Killing(LocalWorkers):
        def wait(self):
            if not told:
                for worker in self._workers:
                    worker.process.kill()
                    worker.process.join()
            told.append(super().wait())
            return told[-1]

    with closing(Killing(2)) as workers:
        assert evaluate_shards(asked, shards=4, workers=workers, folder=folder) == tally
    lost = [answer for answers in told for _, answer in answers if answer.value is None]
    assert 1 <= len(lost) <= 2 and all("was killed by signal 9" in str(answer.error) for answer in lost)
    assert finished(folder) == 4


@pytest.mark.slow
def test_processes__are_ended_where_a_shard_fails_or_on_ctrl_c(asked, monkeypatch, tmp_path: Path) -> None:
    changed = replace(asked, identity={**asked.identity, "seed": 12})
    with pytest.raises(InvalidInput, match="seed changed since the evaluation began"):
        evaluate_shards(changed, shards=4, jobs=2)
    folder = tmp_path / "kept"

    def stop(progress) -> None:
        if progress.done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate_shards(asked, shards=4, jobs=2, folder=folder, tell=stop)
    assert 1 <= finished(folder) < 4 and not active_children()


def test_another_question__is_refused_and_told(asked, paper_random, tmp_path: Path) -> None:
    evaluate_shards(asked, shards=1, folder=tmp_path)
    other = Question(paper_random, ("full_brake",), N, 12).ask()
    with pytest.raises(
        InvalidInput,
        match=r"holds shards with other settings \(seed 11, here 12; agents; policy-sha256 coast; knows coast",
    ):
        evaluate_shards(other, shards=1, folder=tmp_path)
    with pytest.raises(InvalidInput, match="rows False, here True"):
        evaluate_shards(asked, shards=1, folder=tmp_path, with_rows=True)


def test_a_folder_of_something_else__is_left_alone(asked, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(AlreadyExists, match="holds no shards"):
        evaluate_shards(asked, shards=1, folder=tmp_path)
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_a_damaged_line__is_told_and_its_worlds_are_driven_again(asked, tally, driven, tmp_path: Path) -> None:
    evaluate_shards(asked, shards=4, folder=tmp_path)
    journal = tmp_path / "journal.jsonl"
    whole = journal.read_text()
    journal.write_text(whole.replace('"worlds": 1000', '"worlds": 1001', 1))
    driven.clear()
    told = []
    assert evaluate_shards(asked, shards=4, folder=tmp_path, tell=told.append) == tally
    assert driven == [(0, 1_000)] and "1 finished shard damaged" in told[0].note


def test_lines_of_another_journal__make_no_world_count_twice(asked, tally, tmp_path: Path) -> None:
    journals = [tmp_path / name / "journal.jsonl" for name in ("one", "other")]
    for shards, journal in enumerate(journals, 1):
        evaluate_shards(asked, shards=shards, folder=journal.parent)
    journals[0].write_text(journals[0].read_text() + journals[1].read_text())
    assert evaluate_shards(asked, shards=1, folder=tmp_path / "one") == tally


def test_rows__are_the_same_for_any_shards_and_those_of_killed_shards_go(asked, tally, tmp_path: Path) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    tables = []
    for shards in (1, 4):
        folder = tmp_path / str(shards)
        if shards == 4:
            interrupted(asked, folder, 2, shards, with_rows=True)
            (folder / "worlds-0000000002000-0000000004500.parquet").write_bytes(b"half")
        again = evaluate_shards(asked, shards=shards, folder=folder, with_rows=True, block=1_000 * shards)
        assert again == tally
        files = sorted(folder.glob("worlds-*.parquet"))
        assert len(files) == shards
        tables.append([row for file in files for row in parquet.read_table(file).to_pylist()])
    assert tables[0] == tables[1]
    assert [(row["world"], row["agent"]) for row in tables[0][:3]] == [
        (0, "full_brake"),
        (0, "coast"),
        (1, "full_brake"),
    ]
    braking = [row["total_harm"] for row in tables[0] if row["agent"] == "full_brake"]
    assert len(braking) == N
    assert np.mean(braking) == pytest.approx(tally.agents["full_brake"].moments["total_harm"].mean, rel=1e-12)
    damaged = tmp_path / "1" / "worlds-0000000000000-0000000004500.parquet"
    damaged.write_bytes(b"")
    assert evaluate_shards(asked, shards=1, folder=tmp_path / "1", with_rows=True) == tally  # driven again
    assert parquet.read_table(damaged).num_rows == 2 * N
