"""What the package stands on: every pinned package with its licence, read from the environment.

A package fails that has no licence that is known here, or another version than it is pinned to.
"""

import re
from collections import Counter
from functools import partial
from importlib.metadata import PackageNotFoundError, metadata
from typing import NamedTuple

from tests.programmes import ROOT, Cases, Given, Told

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
    pins = re.findall(r"^([A-Za-z0-9._-]+)==(\S+)", (ROOT / "constraints.txt").read_text("utf-8"), re.MULTILINE)
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


def cases(given: Given) -> Cases:
    found = packages()
    for each in found:
        good = not each.fault if each.installed else None
        told = f"{each.installed or 'not here'}, {each.family or each.licence} {each.fault}"
        yield each.name, partial(Told, good, told.strip(" ,"))
    counts = Counter(each.family or "unknown" for each in found if each.installed)
    yield f"{len(found)} pinned", partial(Told, None, ", ".join(f"{n} {name}" for name, n in counts.items()))
