"""What datasets and clones of them refuse."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

import ethbrake_marl as eb
from ethbrake_marl.errors import AlreadyExists, UnknownName
from ethbrake_marl.extensions.datasets import minari
from ethbrake_marl.extensions.datasets.minari import write_dataset
from tests.docs.site import DOCS, load
from tests.refused import refused

PAPER, PAIR = eb.load_scenario("paper-random"), eb.load_scenario("cooperation-3-pair")


BRAKE = {"full_brake": eb.make_agent("full_brake")}


def dataset(path: str = "a.parquet", agents: Any = None, **given: Any) -> None:
    """Writes a dataset of two episodes, as if the extra were installed."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(minari, "need", lambda package: None)
        write_dataset(path, BRAKE if agents is None else agents, **{"scenario": PAPER, "episodes": 2, **given})


NOBODY = PAPER.with_learners([])


DATASETS: dict[str, Callable[[], object]] = {
    "write_dataset: episodes = 0: must be a whole number, at least 1": lambda: dataset(episodes=0),
    "write_dataset: there are no agents; give at least one": lambda: dataset(agents={}),
    "a.parquet: a dataset in the format minari must be a folder called NAME-vNUMBER": lambda: dataset(format="minari"),
    "a-v0: a dataset in the format parquet must be a file ending in .parquet": lambda: dataset(
        "a-v0", format="parquet"
    ),
    "brakes: the folder of a Minari dataset must be named NAME-vNUMBER": lambda: dataset("brakes"),
    "nowhere/a.parquet: the folder nowhere does not exist; create it first": lambda: dataset("nowhere/a.parquet"),
    "nowhere/a-v0: the folder nowhere does not exist; create it first": lambda: dataset("nowhere/a-v0"),
    "has no learner to record; use scenario.with_learners(['vehicle_2'])": lambda: dataset(scenario=NOBODY),
    "scenario 'cooperation-3-pair' has 2 learners (vehicle_2, vehicle_3)": lambda: dataset("a-v0", scenario=PAIR),
}


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("message", DATASETS)
def test_dataset__is_refused(message: str) -> None:
    with refused(message):
        DATASETS[message]()


@pytest.mark.parametrize(("name", "make"), [("a.parquet", Path.touch), ("a-v0", Path.mkdir)])
def test_dataset__replaces_nothing_unasked(name: str, make: Callable[[Path], None], empty_folder: Path) -> None:
    make(Path(name))
    with refused("; give another name", AlreadyExists):
        dataset(name)


def test_dataset__replaces_no_folder_that_is_none(empty_folder: Path) -> None:
    Path("a-v0").mkdir()
    with refused("a-v0: this is not a Minari dataset, so force (--force) does not replace it; give another name"):
        dataset("a-v0", force=True)
    with refused("unknown format 'csv'; known: minari, parquet", UnknownName):
        dataset(format="csv")


def test_clone__is_of_one_learner_of_a_dataset_and_says_which_drives(empty_folder: Path) -> None:
    Path("no.parquet").write_text("no")
    clone = load("../../train/clone")
    with refused("no.parquet: must be a Parquet file from `write_dataset`"):
        clone.train(Path("no.parquet"), 0, Path("clone"))
    write_dataset("two.parquet", BRAKE, scenario=PAIR, episodes=1)
    with refused("two.parquet: has 2 learners; it must have one"):
        clone.train(Path("two.parquet"), 0, Path("clone"))
    Path("clone.py").write_text((DOCS.parent / "train" / "clone.py").read_text())
    with refused("agent 'clone.py:make_agent': give the clone's folder: train/clone.py:make_agent:runs/clone"):
        eb.make_agent("clone.py:make_agent", scenario=PAPER)
