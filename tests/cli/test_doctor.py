from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from ethbrake_marl import physics, scenario
from ethbrake_marl.agents import e_v2x_bm
from ethbrake_marl.cli import doctor
from ethbrake_marl.cli.doctor import Check, diagnose

ROOT = Path(__file__).resolve().parents[2]


def found(name: str) -> Check:
    return next(check for check in diagnose() if check.name == name)


def test_doctor__a_sound_installation_is_ok(ethbrake):
    answer = ethbrake("doctor")
    assert (answer.status, answer.err) == (0, "")
    lines = answer.out.splitlines()
    assert all(line.startswith("OK ") for line in lines)
    names = {line.split()[1] for line in lines}
    assert names >= {"python", "numpy", "torch", "physics", "baseline", "scenarios", "kernel"}


def test_doctor_json__is_pure(ethbrake):
    answer = ethbrake("doctor", "--json")
    checks = json.loads(answer.out)
    assert [check["name"] for check in checks] == [check.name for check in diagnose()]
    assert all(check["ok"] is True for check in checks)


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_doctor__one_failure_gives_exit_status_1(ethbrake, monkeypatch, form):
    checks = [Check("a", True, "x"), Check("b", False, "y")]
    monkeypatch.setattr("ethbrake_marl.cli.doctor.diagnose", lambda compile_all: checks)
    answer = ethbrake("doctor", *form)
    assert answer.status == 1
    assert ("FAIL  b  y" in answer.out) == (not form)


def test_dependencies__too_old_and_missing_ones_fail(monkeypatch):
    wanted = [("", "numpy>=99"), ("", "no-such-package>=1"), ("", "scipy>=1"), ("train", "no-such-extra>=1")]
    monkeypatch.setattr(doctor, "_requirements", lambda: [(extra, Requirement(line)) for extra, line in wanted])
    numpy, missing, scipy, optional = (found(name) for name in ("numpy", "no-such-package", "scipy", "no-such-extra"))
    assert not numpy.ok
    assert "needs >=99" in numpy.detail
    assert (missing.ok, missing.detail) == (False, "is not installed; needs >=1")
    assert scipy.ok
    assert (optional.ok, optional.detail) == (True, "is not installed; the extra train brings it")


def test_dependencies__another_version_than_the_tested_one_is_mentioned(monkeypatch):
    monkeypatch.setattr(doctor, "_pinned_versions", lambda path: {"numpy": "1.0"})
    assert found("numpy").ok
    assert "(tested with 1.0)" in found("numpy").detail


def test_dependencies__each_stands_with_the_extra_that_brings_it():
    extra_of = {requirement.name: extra for extra, requirement in doctor._requirements()}
    assert extra_of["numpy"] == extra_of["numba"] == ""
    assert (extra_of["torch"], extra_of["benchmarl"], extra_of["onnx"]) == ("train", "marl", "export")
    assert extra_of["ray"] == "cluster"
    assert "pytest" not in extra_of


def test_physics__a_kernel_that_gives_other_harm_fails(monkeypatch):
    exact = physics.advance

    def doubled(*args, **kwargs):
        worlds, impacts = exact(*args, **kwargs)
        return worlds, dataclasses.replace(impacts, total_harm=2.0 * impacts.total_harm)

    monkeypatch.setattr(physics, "advance", doubled)
    assert not found("physics").ok
    assert "harm 40 (exact: 20)" in found("physics").detail


def test_baseline__another_optimum_fails(monkeypatch):
    exact = e_v2x_bm.optimise_pairwise

    def shifted(worlds, vehicle):
        best = exact(worlds, vehicle)
        return best._replace(deceleration_mps2=best.deceleration_mps2 + 1e-4)

    monkeypatch.setattr(e_v2x_bm, "optimise_pairwise", shifted)
    assert not found("baseline").ok


def test_scenarios__a_damaged_folder_is_a_finding_and_no_crash(monkeypatch):
    def missing() -> None:
        raise OSError("gone")

    monkeypatch.setattr(scenario, "list_scenarios", missing)
    assert (found("scenarios").ok, found("scenarios").detail) == (False, "OSError: gone")


def test_kernel_cache__a_folder_that_cannot_be_written_is_mentioned(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("")
    program = "from ethbrake_marl.cli.doctor import _kernel_cache; print(_kernel_cache()[1])"
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(blocked)}
    environment["TMPDIR"] = str(tmp_path)
    result = subprocess.run(
        [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
    )
    assert "temporary" in result.stdout
