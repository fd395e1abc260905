"""Wheel and sdist, built twice: ``make dist`` leaves them in dist/, if both builds have the same bytes.

``python -m tests.wheel.reproducible [--output FOLDER]`` prints the SHA-256 of each file, and exits with status 1 where
two builds differ.
"""

from __future__ import annotations

import argparse
import hashlib
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def build(folder: Path) -> dict[str, bytes]:
    """Build wheel and sdist into ``folder``, by uv; every file's content by its name."""
    uv = Path(sys.executable).with_name("uv")
    subprocess.run([str(uv), "build", "--quiet", "--out-dir", str(folder), str(ROOT)], check=True)
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir()) if path.suffix in (".whl", ".gz")}


def main() -> None:
    """Build twice, compare, and keep the second."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=ROOT / "dist", help="folder of the two files")
    output = parser.parse_args().output
    with tempfile.TemporaryDirectory(prefix="ethbrake-dist-") as first, tempfile.TemporaryDirectory() as second:
        files, again = build(Path(first)), build(Path(second))
    same = files == again and len(files) == 2
    for name, content in again.items():
        print(f"{'ok    ' if files.get(name) == content else 'FAILED'}  {hashlib.sha256(content).hexdigest()}  {name}")
    if same:
        output.mkdir(exist_ok=True)
        for name, content in again.items():
            (output / name).write_bytes(content)
    sys.exit(0 if same else 1)


if __name__ == "__main__":
    main()
