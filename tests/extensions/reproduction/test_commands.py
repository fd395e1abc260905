"""`ethbrake reproduce`: what it leaves."""

from pathlib import Path

import pytest

from tests.fixtures.commands import Command, Refuse, told_json
from tests.test_imports import ended

pytestmark = pytest.mark.usefixtures("empty_folder")


def test_reproduce__says_what_it_takes_makes_one_item_and_keeps_it(ethbrake: Command) -> None:
    words = ("reproduce", "accelerations", "--episodes", "20", "--output", "out")
    answer = ethbrake(*words, "--json")
    assert "to do: 1 item," in answer.err and "page: out/index.html" in answer.err
    (result,) = told_json(answer)
    assert result["name"] == "accelerations" and result["verdict"]["outcome"] in ("agrees", "differs")
    file = Path("out/accelerations/result.json")
    made = file.stat().st_mtime_ns
    assert ethbrake(*words).status == 0 and file.stat().st_mtime_ns == made


def test_items__of_the_paper_need_no_torch() -> None:
    program = "import sys, ethbrake_marl.extensions.reproduction.items; print({'torch'} & set(sys.modules))"
    assert ended(program) == (0, "set()\n", "")


REFUSED = [
    ("reproduce harm-delay", "unknown item 'harm-delay'; did you mean 'harm-delays'?"),
    ("reproduce gaps gaps", "item 'gaps' is given twice"),
    ("reproduce --quick --full", "--quick and --full cannot be combined; give only one of them"),
    (
        "reproduce gaps --episodes 1",
        "Invalid value for '--episodes': must be greater than or equal to 2 (see: ethbrake reproduce --help)",
    ),
]


@pytest.mark.parametrize(("line", "message"), REFUSED, ids=lambda value: value[:60])
def test_reproduction__is_refused(line: str, message: str, refuse: Refuse) -> None:
    refuse(line, message)
