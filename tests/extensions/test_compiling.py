"""On which sources machine code depends, if the kernels of one extension call those of another."""

from pathlib import Path

import pytest

from ethbrake_marl.motion import compiling

KERNELS = """
from ethbrake_marl.motion.compiling import large

@large
def answer(x):
    return {factor} * x
"""


def test_stamp__depends_on_the_kernels_of_another_extension(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stamp() -> str:
        for known in (compiling.stamp_of, compiling._source):
            known.cache_clear()
        return compiling.stamp_of(str(file))

    monkeypatch.setattr(compiling, "PACKAGE", tmp_path)
    one, other = tmp_path / "extensions/one", tmp_path / "extensions/other"
    for folder in (one, other):
        folder.mkdir(parents=True)
        (folder / "kernels.py").write_text(KERNELS.format(factor=2.0))
    file, text = one / "kernels.py", KERNELS.format(factor=5.0)
    alone = stamp()
    (other / "kernels.py").write_text(text)
    assert stamp() == alone
    file.write_text(f"{file.read_text()}\nfrom ethbrake_marl.extensions.other.kernels import answer\n")
    with_other = stamp()
    (other / "kernels.py").write_text(KERNELS.format(factor=2.0))
    assert stamp() != with_other != alone
