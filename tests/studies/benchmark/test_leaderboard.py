"""What the leaderboard takes, how it ranks, and every entry that it refuses by name."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from ethbrake_marl.errors import InvalidInput, UnknownName
from ethbrake_marl.studies.benchmark import plain_sha256, read_leaderboard

NAMES = ("full_brake", "coast", "full_brake+episode")


@pytest.fixture
def kept(entries: Path, tmp_path: Path) -> Path:
    """A copy of the entries, to be changed."""
    folder = tmp_path / "entries"
    shutil.copytree(entries, folder)
    return folder


def paths(folder: Path) -> list[Path]:
    return [folder / f"{name}.json" for name in NAMES]


def change(file: Path, edit: Callable[[dict[str, Any]], None], *, bind: bool = True) -> None:
    """Edit an entry as somebody would who knows how its hash is made."""
    content = json.loads(file.read_text())
    edit(content)
    if bind:
        content["entry_sha256"] = plain_sha256({k: v for k, v in content.items() if k != "entry_sha256"})
    file.write_text(json.dumps(content))


def test_entries__are_ranked_by_their_score_and_those_of_some_lists_stand_below(tiny, entries):
    found = read_leaderboard(paths(entries), tiny)
    *ranked, last = [entry for _, entry in found.entries]
    assert last.agent == "full_brake+episode" and last.overall is None and len(ranked) == 2
    shares = [entry.overall.value for entry in ranked]
    assert shares == sorted(shares, reverse=True)
    assert read_leaderboard(paths(entries)[::-1], tiny) == found


def test_table__is_told_as_markdown(tiny, entries):
    found = read_leaderboard(paths(entries), tiny)
    lines = found.table().markdown().splitlines()
    assert lines[0] == "|  | Agent | Overall | paper-random | paper-random-obstacle | cooperation-3-pair |"
    assert (
        "| – | `full_brake+episode` | (" in lines[-1] and "2 of 3 lists) | " in lines[-1] and lines[-1].endswith("– |")
    )


def leave_out_list(content):
    del content["lists"]["cooperation-3-pair"]


def other_suite(content):
    content["suite_sha256"] = "0" * 64


def more_lists(content):
    content["lists"]["easy"] = content["lists"]["paper-random"]


REFUSED = [
    (leave_out_list, "is about another suite: tiny with SHA-256 "),
    (other_suite, "is about another suite: tiny with SHA-256 000000000000"),
    (more_lists, "is about another suite: tiny with SHA-256 "),
    (lambda content: content.pop("versions"), "versions: is missing"),
    (lambda content: content.update(score=1), "score: unknown key"),
    (lambda content: content.update(lists_driven=True), "lists_driven: must be"),
    (lambda content: content["overall"].update(value="1"), "overall.value: must be a number"),
    (lambda content: content["overall"].update(mean=1.0), "overall.mean: "),
]


@pytest.mark.parametrize(("edit", "told"), REFUSED, ids=lambda each: getattr(each, "__name__", ""))
def test_entries__that_were_edited_are_refused_by_name(tiny, kept, edit, told):
    change(kept / "coast.json", edit)
    with pytest.raises(InvalidInput, match=rf"coast\.json.*{re.escape(told)}"):
        read_leaderboard(paths(kept), tiny)


def test_edited_numbers__do_not_fit_the_entrys_own_hash(tiny, kept):
    change(kept / "coast.json", lambda content: content.update(agent="mine"), bind=False)
    with pytest.raises(InvalidInput, match=r"coast\.json: was changed after it was made"):
        read_leaderboard(paths(kept), tiny)


def test_files_that_are_no_entries__are_refused(tiny, kept):
    (kept / "coast.json").write_text("[]")
    with pytest.raises(InvalidInput, match=r"coast\.json"):
        read_leaderboard(paths(kept), tiny)
    (kept / "coast.json").write_text("{")
    with pytest.raises(InvalidInput, match=r"coast\.json: is no JSON"):
        read_leaderboard(paths(kept), tiny)
    with pytest.raises(InvalidInput, match="no entries given"):
        read_leaderboard([], tiny)
    with pytest.raises(UnknownName, match="suite 'tiny'"):
        read_leaderboard([kept / "full_brake.json"])
