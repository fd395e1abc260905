"""What holds for every test: one thread, no display, the same examples in every run."""

import os
import signal
import sys
from pathlib import Path

import pytest
from hypothesis import settings

# Before the first numerical import: each pool reads its variable once.
os.environ |= dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1") | {
    "MPLBACKEND": "Agg", "SDL_VIDEODRIVER": "dummy", "SDL_AUDIODRIVER": "dummy", "PYGAME_HIDE_SUPPORT_PROMPT": "1",
}  # fmt: skip

FIXTURES = ("installed", "kernels", "pictures", "commands", "registered", "other_law")
pytest_plugins = [f"tests.fixtures.{name}" for name in FIXTURES]

# A shell's background job ignores Ctrl-C, and so would all processes that it starts; the tests send it.
signal.signal(signal.SIGINT, signal.default_int_handler)

# No deadline: the first example of a property pays for the kernel's compilation.
settings.register_profile("deterministic", derandomize=True, deadline=None, database=None, print_blob=True)
settings.load_profile("deterministic")


@pytest.fixture
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(autouse=True)
def _one_torch_thread() -> None:
    """Torch on one thread, for tests that loaded it; the others never pay for its import."""
    torch = sys.modules.get("torch")
    if torch is not None and torch.get_num_threads() != 1:
        torch.set_num_threads(1)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--all", action="store_true", help="the slow tests, too, as continuous integration")
    parser.addoption("--first-case", action="store_true", help="of each parametrised test the first case alone")
    parser.addoption("--games", type=int, help="how many random games to play; by default 50, with --all 500")
    parser.addoption("--games-seed", type=int, default=1, help="which random games")
    parser.addoption("--size", type=int, default=1, help="how many times their least work the nightly tests do")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("all"):
        config.option.markexpr = "not nightly"


@pytest.fixture(scope="session")
def size(request: pytest.FixtureRequest) -> int:
    return int(request.config.getoption("size"))


@pytest.hookimpl(trylast=True)  # behind the choice by marks
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("first_case"):
        first = {item.nodeid.partition("[")[0]: item for item in reversed(items)}
        config.hook.pytest_deselected(items=[item for item in items if item not in first.values()])
        items[:] = [item for item in items if item in first.values()]
