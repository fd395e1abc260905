"""Every block of every page is run, as tests/docs/blocks.py says; without ``--all`` one block of each page."""

from pathlib import Path

import pytest

from ethbrake_marl.cli.trial import COMPARED
from tests.docs.blocks import Reader, blocks
from tests.docs.printed import PAGES, ROOT

WITH_BLOCKS = [page for page in PAGES if blocks(page)]


@pytest.mark.filterwarnings("ignore::UserWarning:minari", "ignore::FutureWarning:copyreg")
@pytest.mark.parametrize("page", WITH_BLOCKS, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_page__its_blocks_run_and_print_what_it_shows(
    page: Path, empty_folder: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(empty_folder))
    reads_all = request.config.getoption("all")
    if not reads_all:
        monkeypatch.delitem(COMPARED, "best known", raising=False)  # a search, in `scenario validate`
    reader = Reader(reads_all)
    for block in blocks(page):
        reader.read(block)


def read(page: Path, text: str) -> None:
    page.write_text(text)
    reader = Reader(reads_all=True)
    for block in blocks(page):
        reader.read(block)


FAULTS = {
    "NameError": "```python\nprint(nothing)\n```",
    "page.md:1": "~~~python\nprint(1.25)  # 1.3\n~~~",
    "-2": "- A list:\n\n  ```python\n  print(1)\n  ```\n\n  ```\n  2\n  ```",
    "No such option: --agent": "```sh\nethbrake evaluate --agent ppo\n```",
    "unknown agent 'pop'": "```console\n$ ethbrake evaluate --agents pop\n```",
    "no target tests": "```sh\nmake tests\n```",
    "unknown extra": "```sh\npip install '.[marll]'\n```",
    "gap_m: unknown key": "```yaml\ngap_m: 3\n```",
    "entry points": "```toml\n[project.entry-points.'ethbrake_marl.agent']\na = 'b:c'\n```",
    "nothing runs a block of '(indented)'": "Text:\n\n    x = 1",
    "unknown mark 'later'": "<!-- block: later -->\n```python\n```",
    "a mark without a block": "<!-- block: slow -->\n\nText.",
    "shows output of no block": "Text.\n\n```\n1\n```",
    "has no line gap": "```sh\nethbrake scenario new mine\n```\n<!-- block: change mine.yaml -->\n```yaml\ngap: 3\n```",
}


@pytest.mark.parametrize("message", FAULTS)
def test_fault__of_a_page_is_seen(message: str, empty_folder: Path) -> None:
    with pytest.raises(Exception) as error:
        read(empty_folder / "page.md", FAULTS[message])
    assert message in f"{error.typename}: {error.value}"


def test_page__that_is_right_is_read(empty_folder: Path) -> None:
    page = """```python
for k in range(3):
    print(k, 0.125)
```

```
0 0.1...
...
2 0.125
```

<!-- block: write worlds.csv -->
```
gap_1_m,gap_2_m
7,8
```

<!-- block: short 1000=2 -->
```console
$ python -m ethbrake_marl evaluate --episodes 1000 --agents coast --json
[
...
]
```

<!-- block: show worlds.csv -->
```
gap_2_m
8
```
"""
    read(empty_folder / "page.md", page)
