"""A report in a browser."""

from pathlib import Path

import pytest

from ethbrake_marl.evaluation.comparison import Comparison
from ethbrake_marl.extensions.report.figures import harm_against_total_gap
from ethbrake_marl.extensions.report.page import drawing
from ethbrake_marl.extensions.report.report import ReportPage
from tests.fixtures.browser import browser as browser, open_page as open_page


@pytest.fixture(scope="session")
def report_file(compared: Comparison, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report of ``compared``."""
    figure = drawing(harm_against_total_gap(compared.result), "Harm against the gap", "Mean harm by gap.")
    path = tmp_path_factory.mktemp("report") / "report.html"
    ReportPage("paper-random: four agents", compared, "Four agents.", {"Seed": 7}, figures=[figure]).write(path)
    return path
