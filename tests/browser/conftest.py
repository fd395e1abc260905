"""Debian's or the machine's own Chromium, driven by Playwright; skipped, and said so, where either is missing."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from ethbrake_marl.evaluation import Evaluation, evaluate, summarise
from ethbrake_marl.evaluation.inputs import make_lineup
from ethbrake_marl.pages.page import Part
from ethbrake_marl.pages.report import Report
from ethbrake_marl.scenario import load_scenario

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
AGENTS = ("full_brake", "e_v2x_bm", "constant:3+step", "ppo@shipped")


def chromium_path() -> str | None:
    """The browser that ETHBRAKE_CHROMIUM names, or the first one found."""
    named = os.environ.get("ETHBRAKE_CHROMIUM")
    return named or next((found for name in NAMES if (found := shutil.which(name))), None)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """One browser for the tests of a module: while it is open, its event loop runs, and other tests have their own."""
    api = pytest.importorskip("playwright.sync_api", reason="no Playwright: pip install 'ethbrake-marl[dev]'")
    path = chromium_path()
    if path is None:
        pytest.skip("no Chromium: apt-get install chromium, or name one by ETHBRAKE_CHROMIUM")
    with api.sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=path, args=["--no-sandbox", "--disable-gpu"])
        yield started
        started.close()


@pytest.fixture
def open_page(browser: Any) -> Iterator[Callable[..., Any]]:
    """Opens a file; by the end of the test the console was told nothing, and no other place was asked for anything."""
    told: list[str] = []
    contexts = []

    def open_file(path: Path, *, width: int = 1280, **settings: Any) -> Any:
        context = browser.new_context(viewport={"width": width, "height": 900}, **settings)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: told.append(f"console: {message.text}"))
        page.on("pageerror", lambda error: told.append(f"error: {error}"))
        page.on("request", lambda request: told.append(request.url) if request.url != path.as_uri() else None)
        page.goto(path.as_uri())
        return page

    yield open_file
    for context in contexts:
        context.close()
    assert told == []


@pytest.fixture(scope="session")
def compared() -> Evaluation:
    """Four agents in 120 worlds, one of them behind a shield."""
    scenario = load_scenario("paper-random")
    return evaluate(scenario.sample(120, 7), make_lineup(AGENTS, scenario), scenario=scenario, seed=7)


@pytest.fixture(scope="session")
def report_file(compared: Evaluation, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of ``compared``."""
    from ethbrake_marl.figures import harm_against_total_gap

    rows = summarise(compared)
    agents = make_lineup(AGENTS, compared.scenario)
    figure = Part.drawing(harm_against_total_gap(compared), "Harm against the gap", "Mean harm by gap.")
    report = Report(
        "paper-random: four agents", rows, compared, figures=[figure],
        summary="A report for the tests.", settings={"Seed": 7}, versions={"numpy": "2"},
    )  # fmt: skip
    path = tmp_path_factory.mktemp("report") / "report.html"
    replace(report.driven(agents), shield=None).write(path)
    return path
