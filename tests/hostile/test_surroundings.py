"""Whoever runs the attack, as root too: no case names a place outside the attack's folder, and none can write there."""

from __future__ import annotations

import os
import random
import signal
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.hostile.cage import judge
from tests.hostile.case import HERE, INSIDE, Case, placed
from tests.hostile.command_cases import TARGETS, VARIABLES, WRITERS, commands
from tests.hostile.confined import can_confine, confine
from tests.hostile.place_cases import places
from tests.hostile.surroundings import gained, listing, strays


def named(*command: str, **environment: str) -> Case:
    return Case("command", "made up", command, lambda folder: None, environment=environment)


@pytest.fixture
def inside(tmp_path: Path) -> Iterator[Path]:
    """The folder where a case's command runs; the attack's own is ``tmp_path``."""
    folder = tmp_path / "command-0" / INSIDE
    folder.mkdir(parents=True)
    return folder


def test_cases__name_no_place_outside(inside, tmp_path):
    for case in (*commands(random.Random("0 command")), *places(random.Random("0 place"))):
        assert strays(placed(case, inside), inside, tmp_path) == [], case.command


def test_cases__write_to_places_that_nobody_can_write_to(inside, tmp_path):
    assert len(TARGETS) * len(WRITERS) == 55
    for variables in VARIABLES:
        case = placed(named(**variables), inside)
        assert not any(
            value.startswith("/") and not value.startswith(f"{inside}") for value in case.environment.values()
        )


@pytest.mark.parametrize(
    "case",
    [
        named("train", "--output", "/nowhere/x"),
        named("train", "--output", "../../../x"),
        named("scenario", "new", "mine", "--output", "/"),
        named("evaluate", "--per-world", "/dev/null"),
        named("evaluate", "--agents", "ppo@/tmp/x"),
        named("evaluate", "--initial-states=/root/w.csv"),
        named("evaluate", TMPDIR="/tmp"),
    ],
    ids=lambda case: " ".join((*case.command, *case.environment)),
)
def test_strays__are_told_and_their_case_is_not_run(case, tmp_path):
    own = tmp_path / "own"
    own.mkdir()
    verdict = judge(case, own / "command-0", set())
    assert [fault for fault in verdict.faults if fault.startswith("names a place outside: ")], verdict
    assert (verdict.message, os.listdir(own)) == ("not run", [])


def test_strays__a_device_may_be_read_and_what_is_below_the_own_folder_named(inside, tmp_path):
    (inside / "zero").symlink_to("/dev/zero")
    (inside / "beside").symlink_to("../../x")
    case = placed(named("evaluate", "--agents", "ppo@/dev/zero", "--per-world", f"{HERE}/x", "..", "../../x"), inside)
    assert strays(case, inside, tmp_path) == []
    (inside / "home").symlink_to("/root")
    assert strays(case, inside, tmp_path) == ["home -> /root"]


def test_gained__tells_new_files_that_have_a_name_of_a_case(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "old").touch()
    around = listing(tmp_path / "own")
    for name in ("mine.yaml", "other", "old"):
        (tmp_path / name).touch()
    assert gained(around, {"mine.yaml", "old"}) == [f"{tmp_path / 'mine.yaml'}"]


def test_judge__tells_what_a_build_leaves_beside_its_folder(tmp_path):
    case = Case("command", "made up", ("nonsense",), lambda folder: (folder / "../../x").touch())
    assert "left beside its folder: x" in judge(case, tmp_path / "command-0", set()).faults


def in_a_process_of_its_own(work: Callable[[], None]) -> bool:
    """Whether ``work`` ended without an error."""
    child = os.fork()
    if not child:
        status = 1
        try:
            signal.alarm(20)
            work()
            status = 0
        except BaseException:
            traceback.print_exc()
        os._exit(status)
    return os.waitpid(child, 0)[1] == 0


@pytest.mark.skipif(not can_confine(), reason="the kernel has no Landlock of version 3")
def test_confine__keeps_the_superuser_and_his_children_from_changing_what_is_outside(tmp_path):
    own, outside = tmp_path / "own", tmp_path / "outside"
    own.mkdir()
    outside.mkdir()
    (outside / "kept").write_text("years of work")
    deeds = (
        lambda: (outside / "new").touch(),
        lambda: (outside / "kept").write_text(""),
        lambda: (outside / "kept").unlink(),
        lambda: (outside / "folder").mkdir(),
        lambda: os.mkfifo(outside / "pipe"),
        lambda: (outside / "link").symlink_to("kept"),
        lambda: os.truncate(outside / "kept", 0),
        lambda: os.rename(outside / "kept", own / "kept"),
        lambda: os.rename(own / "mine", outside / "mine"),
    )

    def work() -> None:
        confine(own)
        (own / "mine").write_text("mine")
        Path(os.devnull).write_text("may be written to")
        for deed in deeds:
            with pytest.raises(OSError):
                deed()
        assert os.system(f"touch '{outside}/new' 2>/dev/null") != 0

    assert in_a_process_of_its_own(work)
    assert (os.listdir(outside), (outside / "kept").read_text()) == (["kept"], "years of work")
    assert os.listdir(own) == ["mine"]
