"""Where machine code is kept, if the kernels of one extension call those of another."""

from pathlib import Path

import pytest

from ethbrake_marl.motion import compiling

KERNELS = """
from ethbrake_marl.motion.compiling import large

@large
def answer(x):
    return {factor} * x
"""


def test_folder__depends_on_the_kernels_of_another_extension(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compiling, "PACKAGE", tmp_path)
    one, other, folder_of = tmp_path / "extensions/one", tmp_path / "extensions/other", compiling.folder_of.__wrapped__
    for folder in (one, other):
        folder.mkdir(parents=True)
        (folder / "kernels.py").write_text(KERNELS.format(factor=2.0))
    file, text = one / "kernels.py", KERNELS.format(factor=5.0)
    alone = folder_of(str(file))
    (other / "kernels.py").write_text(text)
    assert folder_of(str(file)) == alone
    file.write_text(f"{file.read_text()}\nfrom ethbrake_marl.extensions.other.kernels import answer\n")
    with_other = folder_of(str(file))
    (other / "kernels.py").write_text(KERNELS.format(factor=2.0))
    assert folder_of(str(file)) != with_other != alone
