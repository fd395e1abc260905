"""The parts of the site's extension that need no Sphinx, loaded from docs/extension/."""

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

DOCS = Path(__file__).resolve().parents[2] / "docs"
sys.path.append(str(DOCS / "studies"))  # which import one another


def load(name: str) -> ModuleType:
    """The module ``docs/extension/NAME.py``."""
    spec = spec_from_file_location(f"site_{name}", DOCS / "extension" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[spec.name] = module  # where its data classes look for it
    spec.loader.exec_module(module)
    return module
