"""What the plain install leaves out: the core imports nothing of it, and the rest says how to install it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import _EXTRA_OF, MissingExtra, naming_extras

ROOT = Path(__file__).resolve().parents[1]
EXTRAS = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]["optional-dependencies"]
LINE = "-m pip install 'ethbrake-marl[train]'"

# Runs what the core promises where no package of an extra can be imported.
WITHOUT_EXTRAS = """
import sys
for name in {absent}:
    sys.modules[name] = None
import ethbrake_marl as eb
from ethbrake_marl.cli.app import run_command
from ethbrake_marl.errors import MissingExtra
from ethbrake_marl import figures

for name in eb.__all__:
    getattr(eb, name)
help(eb)
eb.env(), eb.parallel_env(), eb.EthBrakeEnv(), eb.EthBrakeVectorEnv(2)
for name in ("train", "resume", "TrainResult", "make_sb3_vec_env", "EthBrakeVecEnv", "ShieldedVecEnv"):
    assert name not in dir(eb) and name not in eb.__all__
    try:
        getattr(eb, name)
    except MissingExtra as error:
        assert str(error).endswith({line!r})
    else:
        sys.exit(f"{{name}} was imported")
lineup = "ppo@shipped,ppo@shipped+episode,e_v2x_bm"
assert run_command(["evaluate", "--agents", lineup, "--episodes", "20", "--json"]) == 0
assert run_command(["doctor", "speed", "--quick"]) == 2
sys.exit(run_command(["train", "--steps", "1"]))
"""


def test_core__runs_where_no_extra_can_be_imported(tmp_path: Path) -> None:
    result = subprocess.run(
        [sys.executable, "-c", WITHOUT_EXTRAS.format(absent=sorted(_EXTRA_OF), line=LINE)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 2, result.stderr
    assert result.stderr.splitlines()[-1].endswith(LINE)
    assert list(tmp_path.iterdir()) == []


def test_command__without_its_extra_ends_with_status_2_and_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "onnx", None)
    assert run_command(["agent", "export", "shipped/ppo", "--onnx", str(tmp_path / "new.onnx")]) == 2
    told = capsys.readouterr()
    line = f"{sys.executable} -m pip install 'ethbrake-marl[export]'"
    assert (told.out, told.err) == ("", f"ethbrake: error: needs the package onnx, which is not installed: {line}\n")
    assert list(tmp_path.iterdir()) == []


def test_naming_extras__leaves_other_missing_modules_alone() -> None:
    with pytest.raises(ModuleNotFoundError) as caught, naming_extras():
        import no_such_package_of_ours  # type: ignore[import-not-found]  # noqa: F401
    assert not isinstance(caught.value, MissingExtra)


def test_extras__are_those_of_the_table_and_all_is_their_sum() -> None:
    assert {"dev", "docs", "all", "kernels", *_EXTRA_OF.values()} == set(EXTRAS)
    distribution = {
        "stable_baselines3": "stable-baselines3",
        "pygame": "pygame-ce",
        "imageio_ffmpeg": "imageio-ffmpeg",
        "hydra": "hydra-core",
    }
    for package, extra in _EXTRA_OF.items():
        names = [re.split(r"[<>=\[]", line)[0] for line in EXTRAS[extra]]
        assert distribution.get(package, package) in names
    assert EXTRAS["all"] == [f"ethbrake-marl[{','.join(dict.fromkeys(_EXTRA_OF.values()))}]"]
