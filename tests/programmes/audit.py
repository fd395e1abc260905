"""Dependencies of the package: every pinned package with its licence, read from the environment.

A package fails if its licence is unknown here, or if its version differs from the pinned version.
"""

import re
from collections import Counter
from functools import partial
from importlib.metadata import PackageNotFoundError, metadata
from typing import NamedTuple

from tests.programmes import ROOT, Cases, Given, Told

# Family of a licence -> words that name it. A package with another licence fails, for example with only the GPL.
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
    installed: str  # installed version; empty if not installed
    licence: str  # text of the package's metadata

    @property
    def family(self) -> str:
        """Family of the licence, the first one of several; empty if a licence that applies is unknown."""
        parts = [_family(part) for part in re.split(r"\bAND\b", self.licence.upper())]
        return parts[0] if all(parts) else ""

    @property
    def fault(self) -> str:
        """What is wrong with the package; empty if nothing, or if it is not installed."""
        if self.installed and self.installed.split("+")[0] != self.pinned:
            return f"is pinned to {self.pinned}"
        return f"licence {self.licence!r} is unknown" if self.installed and not self.family else ""


def _family(words: str) -> str:
    """Return the family that is named first. One known licence among alternatives is enough."""
    named = {family: re.search(rf"\b(?:{pattern})\b", words) for family, pattern in FAMILIES.items()}
    known = {family: place.start() for family, place in named.items() if place is not None}
    return min(known, key=known.__getitem__, default="")


def packages() -> list[Package]:
    """Return the packages of constraints.txt, in its order."""
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
        told = f"{each.installed or 'not installed'}, {each.family or each.licence} {each.fault}"
        yield each.name, partial(Told, good, told.strip(" ,"))
    counts = Counter(each.family or "unknown" for each in found if each.installed)
    yield f"{len(found)} pinned", partial(Told, None, ", ".join(f"{n} {name}" for name, n in counts.items()))
