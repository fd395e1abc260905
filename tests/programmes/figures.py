"""Tables and pictures of the pages that commands make in minutes: make them again and compare.

Pictures must have equal pixels. Each number of a table must be among the numbers that its
commands print, to the decimals shown.
"""

import os
import shlex
import subprocess
import sys
import tempfile
from functools import cache, partial
from pathlib import Path

import numpy as np
from PIL import Image, ImageSequence

from tests.docs.printed import ROOT, Shown, missing_figures, pictures, tables
from tests.programmes import Cases, Given, Told


def run(command: str, folder: Path) -> str:
    """Output of a command: stderr, then stdout. Raises ``RuntimeError`` if the command fails."""
    words = shlex.split(command)
    words[1:] = [str(ROOT / word) if word.startswith("docs/studies/") else word for word in words[1:]]
    called = [sys.executable, *(["-m", "ethbrake_marl"] if words[0] == "ethbrake" else []), *words[1:]]
    variables = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "100", "OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"}
    done = subprocess.run(called, cwd=folder, env=variables, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"exit status {done.returncode}: {done.stderr[-300:]}")
    return done.stderr + done.stdout


@cache
def told_by(command: str) -> str:
    """Output of a command, cached, because several tables may use it."""
    with tempfile.TemporaryDirectory() as folder:
        return run(command, Path(folder))


def frames(path: Path) -> list[np.ndarray]:
    """Frames of a film, or the only one of a picture, each [height, width, 4] uint8."""
    with Image.open(path) as image:
        return [np.asarray(frame.convert("RGBA")) for frame in ImageSequence.Iterator(image)]


def unequal_share(old: list[np.ndarray], new: list[np.ndarray]) -> float:
    """Share of the pixels that differ visibly; fainter differences are the drawing library's."""
    pairs = zip(old, new, strict=True)
    return float(np.mean([(np.abs(a.astype(int) - b).max(axis=2) > 8).mean() for a, b in pairs]))


def differing_picture(picture: Shown, folder: Path) -> list[str]:
    """Difference between the pixels of an old and a new picture, in words; empty if there is none."""
    for command in picture.commands:
        run(command, folder)
    old, new = map(frames, (ROOT / "docs" / "figures" / picture.begin, folder / Path(picture.begin).name))
    if (len(old), old[0].shape) != (len(new), new[0].shape):
        return [f"{len(new)} frames of {new[0].shape} pixels, not {len(old)} of {old[0].shape}"]
    share = unequal_share(old, new)
    return [f"{share:.2%} of the pixels"] if share > 1e-4 else []


def compare(shown: Shown, is_picture: bool) -> Told:
    """Make a table or picture again, and compare it."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            if is_picture:
                found = differing_picture(shown, Path(folder))
            else:
                found = missing_figures(shown.text, "\n".join(map(told_by, shown.commands)))
        except RuntimeError as error:
            found = [str(error)]
    return Told(not found, "\n        ".join(f"{each:.200}" for each in found) or "the same")


def cases(given: Given) -> Cases:
    for found, is_picture in ((tables(), False), (pictures(), True)):
        for shown in dict.fromkeys(found):  # a table or picture of several pages only once
            yield f"{shown.page}: {shown.begin:.70}", partial(compare, shown, is_picture)
