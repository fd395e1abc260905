"""train/benchmarl_mappo.py: what cannot be is one line before any training, with or without the extra."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[2] / "train" / "benchmarl_mappo.py"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "-m pip install 'ethbrake-marl[marl]'"),
        (["--scenario", "cooperation-3-pear"], "did you mean 'cooperation-3-pair'?"),
        (["--recipe", "sac"], "recipe 'sac': is for SAC; MAPPO needs one for PPO"),
        (["--steps", "-5"], "total_steps = -5: must be greater than or equal to 1"),
    ],
)
def test_script__refuses_what_cannot_be(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "benchmarl", None)  # cannot be imported, as where the extra is missing
    monkeypatch.setattr(sys, "argv", ["benchmarl_mappo.py", *arguments])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(SCRIPT), run_name="__main__")
    told = capsys.readouterr().err
    assert ended.value.code == 2 and message in told and told.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--output", "there"], "there: is there already, and is no run; give another name"),
        (["--scenario", "cooperation-0-sensors"], "no vehicle learns"),
    ],
)
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::UserWarning", "ignore::FutureWarning")
def test_script__with_the_extra_refuses_what_cannot_be_before_it_trains(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    pytest.importorskip("benchmarl", reason="needs the extra marl")
    monkeypatch.chdir(tmp_path)
    Path("there").mkdir()
    monkeypatch.setattr(sys, "argv", ["benchmarl_mappo.py", *arguments])
    monkeypatch.setattr("benchmarl.experiment.Experiment.run", lambda *_: pytest.fail("training"))
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(SCRIPT), run_name="__main__")
    assert ended.value.code == 2 and message in capsys.readouterr().err
