"""How kernels are compiled: strictly, without the lock, and never from stale machine code."""

from __future__ import annotations

import ast
import importlib
import re
import shutil
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core.errors import NumbaError

import ethbrake_marl
from ethbrake_marl.physics import compiled
from ethbrake_marl.physics.compiled import (
    cache_folder,
    compiled_apart,
    compiled_bare,
    compiled_bare_apart,
    compiled_within,
    kernel_folder,
    kernel_sources,
)
from ethbrake_marl.physics.compiled import compiled as compile_kernel

needs_compiler = pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="compilation is switched off")


@pytest.fixture(autouse=True)
def _own_folder(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    forget_folders()
    yield
    forget_folders()


def forget_folders() -> None:
    cache_folder.cache_clear()
    kernel_folder.cache_clear()


@needs_compiler
def test_compiled__is_strict_and_releases_the_lock():
    kernel = compile_kernel(lambda x: x + 1.0)
    options = kernel.targetoptions
    assert options["fastmath"] is False and options["nogil"] is True and options["error_model"] == "numpy"
    assert options["nopython"] is True and "parallel" not in options


@pytest.mark.parametrize(
    ("way", "more"),
    [
        (compile_kernel, {"forceinline": True}),
        (compiled_apart, {"forceinline": False}),
        (compiled_within, {"inline": "always"}),
        (compiled_bare, {"forceinline": True, "_nrt": False}),
        (compiled_bare_apart, {"forceinline": False, "_nrt": False}),
    ],
)
def test_compiled__asks_for_these_options_and_for_its_own_folder(monkeypatch, way, more):
    asked = []

    def compiler(**options):
        asked.append((options, numba.core.config.CACHE_DIR))
        return lambda function: function

    monkeypatch.setattr(numba, "njit", compiler)
    assert way(forget_folders) is forget_folders
    options = {"cache": True, "fastmath": False, "nogil": True, "error_model": "numpy", **more}
    assert asked == [(options, str(kernel_folder(Path(__file__))))]


@needs_compiler
def test_compiled_bare__leaves_the_counts_of_references_alone():
    @compiled_bare
    def first(values):
        return values[1:][0]

    values = np.arange(3.0)
    before = sys.getrefcount(values)
    assert [first(values) for _ in range(5)] == [1.0] * 5
    assert sys.getrefcount(values) == before
    with pytest.raises(NumbaError, match="NRT required"):
        compiled_bare(lambda n: np.zeros(n))(3)  # it can make no array: told at once


@needs_compiler
def test_compiled__divides_by_zero_as_ieee_does():
    assert compile_kernel(lambda x: 1.0 / x)(0.0) == float("inf")


def test_compiled__leaves_the_cache_setting_of_others_alone(monkeypatch):
    monkeypatch.setattr(numba.core.config, "CACHE_DIR", "/somewhere")
    compile_kernel(lambda x: x)
    assert numba.core.config.CACHE_DIR == "/somewhere"


@needs_compiler
def test_compiled__is_kept_in_the_folder_of_its_sources():
    kernel = compile_kernel(lambda x: x * 2.0)
    assert Path(kernel.stats.cache_path).is_relative_to(kernel_folder(Path(__file__)))


def test_cache_folder__is_in_the_named_place(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "numba"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_folder() == tmp_path / "numba" / "ethbrake_marl" and cache_folder().is_dir()
    forget_folders()
    monkeypatch.delenv("NUMBA_CACHE_DIR")
    assert cache_folder() == tmp_path / "xdg" / "ethbrake_marl"
    forget_folders()
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert cache_folder() == tmp_path / ".cache" / "ethbrake_marl"


def test_cache_folder__that_cannot_be_written_is_replaced_by_a_temporary_one(monkeypatch, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder", "utf-8")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(blocked))
    folder = cache_folder()
    assert folder.is_dir() and folder.name.startswith("ethbrake_marl-") and tmp_path not in folder.parents
    folder.rmdir()


def test_cache_folder__that_is_temporary_goes_at_the_end_of_the_process(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("not a folder", "utf-8")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    at_the_end = []
    monkeypatch.setattr(compiled.atexit, "register", lambda *call, **options: at_the_end.append((call, options)))
    folder = cache_folder()
    (folder / "kernel").write_text("machine code", "utf-8")
    [((act, *given), options)] = at_the_end
    act(*given, **options)
    assert not folder.exists()
    act(*given, **options)  # also when somebody else has removed it


def test_kernel_folder__hashes_the_sources_of_this_package():
    assert Path(ethbrake_marl.__file__).parent == compiled._PACKAGE


@pytest.fixture
def copied(monkeypatch, tmp_path) -> Path:
    package = tmp_path / "ethbrake_marl"
    shutil.copytree(Path(compiled.__file__).parents[1], package, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(compiled, "_PACKAGE", package)
    return package


def folder_of(package: Path, name: str) -> Path:
    forget_folders()
    return kernel_folder(package / name)


@pytest.mark.parametrize(
    ("kernel", "edited", "moves"),
    [
        ("physics/advance.py", "physics/advance.py", True),  # its own file
        ("physics/advance.py", "physics/events.py", True),  # what it calls
        ("shield/certify_kernel.py", "physics/impact.py", True),  # through several files
        ("observations/observe.py", "scenario/features.py", True),  # constants, from a file without kernels
        ("physics/advance.py", "search/moves.py", False),  # kernels that it does not call
        ("physics/events.py", "physics/advance.py", False),  # its callers
        ("physics/advance.py", "physics/worlds.py", False),  # types
    ],
)
def test_kernel_folder__changes_with_what_its_kernels_are_made_of(copied, kernel, edited, moves):
    before = folder_of(copied, kernel)
    assert folder_of(copied, kernel) == before and len(before.name) == 16
    source = copied / edited
    source.write_text(source.read_text("utf-8") + "\n# a change\n", "utf-8")
    assert (folder_of(copied, kernel) != before) == moves


def test_kernel_folder__of_code_that_is_in_no_file_is_one_for_all():
    assert kernel_folder(Path("<stdin>")) == kernel_folder(Path("nowhere.py")) != kernel_folder(Path(__file__))


def test_kernel_folder__changes_with_numba(copied, monkeypatch):
    before = folder_of(copied, "physics/advance.py")
    monkeypatch.setattr(numba, "__version__", "0.0")
    assert folder_of(copied, "physics/advance.py") != before


@needs_compiler
def test_kernel_sources__hold_every_kernel_that_a_kernel_names():
    checked = 0
    for source in sorted(Path(ethbrake_marl.__file__).parent.rglob("*.py")):
        if "@compiled" not in source.read_text("utf-8") or source.name == "compiled.py":
            continue
        place = source.relative_to(Path(ethbrake_marl.__file__).parents[1]).with_suffix("")
        sources = kernel_sources(source)
        for kernel in vars(importlib.import_module(".".join(place.parts))).values():
            if hasattr(kernel, "py_func") and kernel.py_func.__code__.co_filename == str(source):
                for name in kernel.py_func.__code__.co_names:
                    called = kernel.py_func.__globals__.get(name)
                    if hasattr(called, "py_func"):
                        assert Path(called.py_func.__code__.co_filename) in sources, f"{source.name}: {name}"
                        checked += 1
    assert checked > 300


def test_kernel_sources__find_every_import(copied):
    """Kernels import from this package by ``from ethbrake_marl... import`` alone: no other way would be seen."""
    for source in copied.rglob("*.py"):
        if "@compiled" in source.read_text("utf-8"):
            tree = ast.parse(source.read_text("utf-8"))
            found = {module for module, _ in compiled._IMPORT.findall(source.read_text("utf-8"))}
            asked = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module}
            assert {module for module in asked if module.startswith("ethbrake_marl")} == found, source
            assert not [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.level], source
            names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
            assert not {name for name in names if name.startswith("ethbrake_marl.")}, source


def test_compiled_bare__gives_no_array_back():
    bare = []
    for source in sorted(Path(ethbrake_marl.__file__).parent.rglob("*.py")):
        for node in ast.walk(ast.parse(source.read_text())):
            names = {d.id for d in getattr(node, "decorator_list", ()) if isinstance(d, ast.Name)}
            if names & {"compiled_bare", "compiled_bare_apart"}:
                bare.append(f"{source.name}: {node.name}")
                words = set(re.findall(r"\w+", ast.unparse(node.returns)))
                assert words <= {"None", "bool", "int", "float", "tuple"}, bare[-1]
    assert len(bare) > 30
