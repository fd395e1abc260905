"""Loads the scripts of docs/studies."""

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

DOCS = Path(__file__).resolve().parents[2] / "docs"
sys.path.append(str(DOCS / "studies"))  # which import one another


def load(name: str) -> ModuleType:
    spec = spec_from_file_location(f"study_{Path(name).name}", DOCS / "studies" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[spec.name] = module  # where its data classes look for it
    spec.loader.exec_module(module)
    return module
