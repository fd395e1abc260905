"""Nothing in the package runs code from a file, except in the places that pyproject.toml names.

Ruff's S rules refuse it (`make lint`); this test looks for what ruff has no rule for.
"""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
UNRULED = re.compile(
    r"(?<![.\w])(?<!def )(?:compile|__import__)\(|\.extractall\b|\.(?:to|read)_pickle\b|unsafe_load|runpy\."
    r"|joblib\.load\(|allow_pickle=(?!False)|(?<!json)\.load\([^)]*\b(?:device|map_location|custom_objects)=|torch\.load\((?![^)]*\bweights_only=True\))"
)
PLACES = {
    "ethbrake_marl/files/python_file.py",  # a file that the user names is code
    "ethbrake_marl/files/package.py",  # the package itself, from the zip file that Python runs
}


def test_package__runs_no_code_from_files_but_in_the_named_places() -> None:
    files = {path.relative_to(ROOT).as_posix(): path.read_text("utf-8") for path in ROOT.glob("ethbrake_marl/**/*.py")}
    assert {file for file, text in files.items() if UNRULED.search(text)} == PLACES


@pytest.mark.parametrize(
    ("source", "told"),
    [
        ("compile(text)", True), ("re.compile(text)", False), ("open_archive(path).extractall(folder)", True),
        ("json.load(file)", False),
        ("np.load(path, allow_pickle=given)", True), ("yaml.unsafe_load(text)", True),
        ("torch.load(file, weights_only=given)", True),
        ("torch.load(file, weights_only=True)", False),
    ],
)  # fmt: skip
def test_planted__is_found_where_ruff_has_no_rule(source: str, told: bool) -> None:
    assert (UNRULED.search(source) is not None) == told
