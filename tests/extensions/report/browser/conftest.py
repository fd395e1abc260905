"""Debian's or the machine's own Chromium, driven by Playwright; skipped, and said so, where either is missing."""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from ethbrake_marl.evaluation.comparison import Comparison
from ethbrake_marl.extensions.report.figures import harm_against_total_gap
from ethbrake_marl.extensions.report.page import drawing
from ethbrake_marl.extensions.report.report import ReportPage

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """One browser for all tests of a module.

    While it is open, its event loop runs, so tests of other modules have their own.
    """
    api = pytest.importorskip("playwright.sync_api", reason="no Playwright: pip install 'ethbrake-marl[dev]'")
    path = os.environ.get("ETHBRAKE_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if path is None:
        pytest.skip("no Chromium: apt-get install chromium, or name one by ETHBRAKE_CHROMIUM")
    with api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", "--disable-gpu"])
        yield started
        started.close()


@pytest.fixture
def open_page(browser: Any) -> Iterator[Callable[..., Any]]:
    """Function that opens an address.

    At the end of the test, the console must be empty, and no other address may have been requested.
    """
    told: list[str] = []
    contexts = []

    def open_address(address: str, *, width: int = 1280, **settings: Any) -> Any:
        context = browser.new_context(viewport={"width": width, "height": 900}, **settings)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda each: told.append(f"console: {each.text}"))
        page.on("pageerror", lambda error: told.append(f"error: {error}"))
        page.on("dialog", lambda dialog: told.append(f"dialog: {dialog.message}"))
        page.on("request", lambda each: None if each.url.startswith(address) else told.append(each.url))
        page.goto(address)
        return page

    yield open_address
    for context in contexts:
        context.close()
    assert told == []


def wait_until(page: Any, condition: str) -> None:
    """Wait up to two minutes for a JavaScript condition.

    Playwright's own waiting would run code that the pages' security policy forbids.
    """
    for _ in range(4_800):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(25)
    raise AssertionError(condition)


@pytest.fixture(scope="session")
def report_file(compared: Comparison, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of ``compared``."""
    figure = drawing(harm_against_total_gap(compared.result), "Harm against the gap", "Mean harm by gap.")
    path = tmp_path_factory.mktemp("report") / "report.html"
    ReportPage("paper-random: four agents", compared, "Four agents.", {"Seed": 7}, figures=[figure]).write(path)
    return path
