"""A wheel of ready-made kernels, ``ethbrake-marl-kernels``, for this version of Python, in dist/.

It holds the machine code of what Python calls, for two levels of x86-64. A kernel's name holds the hash of all that
makes it: of another version of this package, of numba or of Python it is never loaded.
"""

from __future__ import annotations

import argparse
import base64
import hashlib
import os
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from ethbrake_marl import __version__

ROOT = Path(__file__).resolve().parents[1]
LEVELS = ("x86-64-v3", "x86-64-v2")
KERNELS = "ethbrake_marl_kernels"
LARGEST_BYTES = 5_000_000
DATE = (2020, 1, 1, 0, 0, 0)


def main() -> int:
    """Compile, pack, and say how large it is; 1 where it is too large."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=ROOT / "dist", help="folder of what is built")
    parser.add_argument("--store", type=Path, help="folder below which each level's kernels are kept for the next time")
    given = parser.parse_args()
    given.output.mkdir(exist_ok=True)
    found: dict[str, bytes] = {}
    with tempfile.TemporaryDirectory() as folder:
        for level in LEVELS:
            found |= compile_for(level, (given.store or Path(folder)) / level)
    wheel = pack(found, given.output)
    size = wheel.stat().st_size
    print(f"{hashlib.sha256(wheel.read_bytes()).hexdigest()}  {wheel.name}", flush=True)
    print(f"{len(found)} kernels, {size / 1e6:.2f} MB, at most {LARGEST_BYTES / 1e6:.0f}")
    return int(size > LARGEST_BYTES)


def compile_for(level: str, folder: Path) -> dict[str, bytes]:
    """The kernels of one level, by name."""
    chosen = {"NUMBA_CPU_NAME": level, "NUMBA_CPU_FEATURES": "", "NUMBA_CACHE_DIR": str(folder)}
    command = [sys.executable, "-m", "ethbrake_marl", "doctor", "--compile"]
    subprocess.run(command, env={**os.environ, "PYTHONPATH": str(ROOT), **chosen}, cwd=ROOT, check=True)
    return {file.name: file.read_bytes() for file in sorted(folder.rglob("*.entry"))}


def pack(found: dict[str, bytes], folder: Path) -> Path:
    """Write the wheel."""
    tag = f"cp{sys.version_info.major}{sys.version_info.minor}-none-manylinux2014_x86_64"
    about = f"{KERNELS}-{__version__}.dist-info"
    files = {f"{KERNELS}/__init__.py": b'"""Compiled kernels of ethbrake_marl."""\n'}
    files |= {f"{KERNELS}/{name}": content for name, content in found.items()}
    files[f"{about}/METADATA"] = (
        f"Metadata-Version: 2.1\nName: ethbrake-marl-kernels\nVersion: {__version__}\n".encode()
    )
    files[f"{about}/WHEEL"] = (
        f"Wheel-Version: 1.0\nGenerator: .ci/kernels.py\nRoot-Is-Purelib: true\nTag: {tag}\n".encode()
    )
    record = "".join(f"{name},sha256={_digest(content)},{len(content)}\n" for name, content in files.items())
    files[f"{about}/RECORD"] = f"{record}{about}/RECORD,,\n".encode()
    wheel = folder / f"{KERNELS}-{__version__}-{tag}.whl"
    with zipfile.ZipFile(wheel, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(zipfile.ZipInfo(name, DATE), content, zipfile.ZIP_DEFLATED, 9)
    return wheel


def _digest(content: bytes) -> str:
    return base64.urlsafe_b64encode(hashlib.sha256(content).digest()).rstrip(b"=").decode()


if __name__ == "__main__":
    sys.exit(main())
