"""What the package stands on: every pinned package with its licence, and whether a known weakness is reported of one.

Licences and versions are read from the environment and need no network. Reports of weaknesses do: `pip-audit` asks for
them where it is installed (`pip install pip-audit`); where it is not, or cannot reach its database, that is said and
nothing is claimed. A package fails that has no licence that is known here, or another version than it is pinned to.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
from collections import Counter
from functools import partial
from importlib.metadata import PackageNotFoundError, metadata
from pathlib import Path
from typing import NamedTuple

from tests.programmes import ROOT, Cases, Told

PINS = ROOT / "constraints.txt"

# Family of a licence -> the words that name it. One that is none of these, the GPL without an alternative for instance,
# is told and fails.
FAMILIES = {
    "MIT": "MIT",
    "BSD": "0?BSD|PUBLIC DOMAIN|CC0-1.0",
    "Apache 2.0": "APACHE",
    "PSF": "PSF|PYTHON SOFTWARE",
    "ISC": "ISC",
    "MPL 2.0": "MPL|MOZILLA",
    "LGPL": "LGPL|LESSER GENERAL",
    "Zlib": "ZLIB",
    "Boost": "BSL-1.0",
}


class Package(NamedTuple):
    """A pinned package."""

    name: str
    pinned: str
    installed: str  # empty: it is not
    licence: str  # in its own words

    @property
    def family(self) -> str:
        """The family of its licence, the first one of several; empty where one that must be kept is not known."""
        parts = [_family(part) for part in re.split(r"\bAND\b", self.licence.upper())]
        return parts[0] if all(parts) else ""

    @property
    def fault(self) -> str:
        """What is wrong with it; empty: nothing, or it is not installed."""
        if self.installed and self.installed.split("+")[0] != self.pinned:
            return f"is pinned to {self.pinned}"
        return f"licence {self.licence!r} is none that is known" if self.installed and not self.family else ""


def _family(words: str) -> str:
    """The family that is named first; of alternatives one that is known is enough."""
    named = {family: re.search(rf"\b(?:{pattern})\b", words) for family, pattern in FAMILIES.items()}
    known = {family: place.start() for family, place in named.items() if place is not None}
    return min(known, key=known.__getitem__, default="")


def packages() -> list[Package]:
    """Every package of constraints.txt, in its order."""
    pins = re.findall(r"^([A-Za-z0-9._-]+)==(\S+)", PINS.read_text("utf-8"), re.MULTILINE)
    found = []
    for name, pinned in pins:
        try:
            known = metadata(name)
        except PackageNotFoundError:
            found.append(Package(name, pinned, "", ""))
            continue
        classes = [line.split(" :: ")[-1] for line in known.get_all("Classifier", []) if line.startswith("License ::")]
        own = known.get("License-Expression") or " / ".join(classes) or known.get("License") or ""
        found.append(Package(name, pinned, known["Version"], own.strip().partition("\n")[0]))
    return found


def weaknesses() -> Told:
    """What pip-audit says of the pinned versions."""
    program = shutil.which("pip-audit", path=str(Path(sys.executable).parent))
    if program is None:
        return Told(None, "not asked, pip-audit is not installed here")
    command = [program, "--requirement", str(PINS), "--no-deps", "--disable-pip", "--progress-spinner", "off"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    told = (done.stdout + done.stderr).strip()
    if done.returncode and "vulnerabilit" not in told:
        return Told(None, f"not asked, pip-audit could not: {told.splitlines()[-1:]}")
    return Told(done.returncode == 0, told)


def cases(given: argparse.Namespace) -> Cases:
    found = packages()
    for each in found:
        good = not each.fault if each.installed else None
        told = f"{each.installed or 'not here'}, {each.family or each.licence} {each.fault}"
        yield each.name, partial(Told, good, told.strip(" ,"))
    counts = Counter(each.family or "unknown" for each in found if each.installed)
    yield f"{len(found)} pinned", partial(Told, None, ", ".join(f"{n} {name}" for name, n in counts.items()))
    yield "weaknesses", weaknesses
