"""Every block of every page is run, as tests/docs/blocks.py says."""

from pathlib import Path

import pytest

from tests.docs.blocks import Reader, blocks
from tests.docs.printed import PAGES, ROOT

WITH_BLOCKS = [page for page in PAGES if blocks(page)]


@pytest.mark.usefixtures("empty_folder")
@pytest.mark.parametrize("page", WITH_BLOCKS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_page__its_blocks_run_and_print_what_it_shows(page: Path, request: pytest.FixtureRequest) -> None:
    reader = Reader(request.config.getoption("all"))
    for block in blocks(page):
        reader.read(block)
