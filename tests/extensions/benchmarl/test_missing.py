"""What a user without BenchMARL is told."""

import importlib
import runpy
import sys

import pytest

from ethbrake_marl.errors import MissingExtra


@pytest.mark.parametrize("module", ["task", "tasks"])
def test_module__without_the_extra_says_how_to_install_it(
    module: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for loaded in ["benchmarl", *(each for each in sys.modules if each.startswith("benchmarl."))]:
        monkeypatch.setitem(sys.modules, loaded, None)  # cannot be imported, as where the extra is missing
    name, message = (
        f"ethbrake_marl.extensions.benchmarl.{module}",
        "needs the package benchmarl, which is not installed",
    )
    monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(MissingExtra, match=message):
        importlib.import_module(name)
    if module == "tasks":
        with pytest.raises(SystemExit) as ended:
            runpy.run_module(name, run_name="__main__")
        printed = capsys.readouterr().err
        assert ended.value.code == 2 and printed.startswith(f"tasks.py: error: {message}") and printed.count("\n") == 1
