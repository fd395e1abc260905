"""The packages that ours stands on: licences as docs/security.md lists them, and what is said where nobody can ask."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.programme import audit

PAGE = Path(__file__).resolve().parents[2] / "docs" / "security.md"


def test_packages__that_are_here_have_licences_that_are_known() -> None:
    found = [each for each in audit.packages() if each.installed]
    assert len(found) > 50
    assert [f"{each.name}: {each.licence!r}" for each in found if not each.family] == []


def test_page__lists_every_pinned_package_under_its_licence() -> None:
    part = PAGE.read_text("utf-8").partition("## The packages it stands on")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (\S[^|]*?) \| (\d+) \| (.*?) \|$", part, re.MULTILINE)
    listed = {name: family for family, _, names in rows for name in names.split(", ")}
    assert all(int(number) == len(names.split(", ")) for _, number, names in rows)
    found = audit.packages()
    assert [each.name for each in found if each.name not in listed] == []
    assert len(listed) == len(found)
    assert {each.name: each.family for each in found if each.installed} == {
        each.name: listed[each.name] for each in found if each.installed
    }


@pytest.mark.parametrize(
    ("licence", "family"),
    [
        ("GNU General Public License v3 (GPLv3)", ""),
        ("AGPL-3.0", ""),
        ("", ""),
        ("Proprietary", ""),
        ("MIT", "MIT"),
        ("MIT AND GPL-3.0", ""),
        ("GPL / BSD License", "BSD"),
    ],
)
def test_licence__that_is_not_known_is_a_fault(licence: str, family: str) -> None:
    package = audit.Package("mine", "1.0", "1.0", licence)
    assert package.family == family and bool(package.fault) == (not family)


def test_version__that_is_not_the_pinned_one_is_a_fault_but_not_its_local_part() -> None:
    assert audit.Package("torch", "2.13.0", "2.13.0+cpu", "BSD").fault == ""
    assert audit.Package("torch", "2.13.0", "2.12.0", "BSD").fault == "is pinned to 2.13.0"


@pytest.mark.parametrize(
    ("script", "status", "told"),
    [
        ("echo 'No known vulnerabilities found'", 0, "No known vulnerabilities found"),
        ("echo 'Found 1 known vulnerability in 1 package'; exit 1", 1, "Found 1 known vulnerability"),
        ("echo 'ConnectionError: no route to host' >&2; exit 1", 0, "not asked, pip-audit could not"),
    ],
)
def test_weaknesses__are_told_or_that_nobody_could_be_asked(
    script: str, status: int, told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.executable", str(tmp_path / "python"))
    assert audit.weaknesses() == (0, "weaknesses: not asked, pip-audit is not installed here")
    (tmp_path / "pip-audit").write_text(f"#!/bin/sh\n{script}\n")
    (tmp_path / "pip-audit").chmod(0o755)
    found, said = audit.weaknesses()
    assert found == status and told in said
