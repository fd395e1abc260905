"""Modules whose mutants are tried, and the few test files that try each of their files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "ethbrake_marl"

TORCH = ("torch", "stable_baselines3", "tensorboard.compat.proto.event_pb2")
SCIENCE = ("scipy.stats", "scipy.optimize", "matplotlib.pyplot", "pydantic", "gymnasium", "pettingzoo", "yaml", "rich")


class Suite(NamedTuple):
    """How the mutants of one module are tried."""

    files: tuple[str, ...]  # what is mutated: patterns below the package
    quick: Mapping[str, tuple[str, ...]]  # file below the package -> its test files, the most likely to fail first
    otherwise: tuple[str, ...]  # the test files of all other files
    whole: tuple[str, ...]  # tried, compiled, on what lives through those
    left_out: frozenset[str] = frozenset({"__init__.py"})  # names of files that are not mutated
    interpreted: frozenset[str] | None = frozenset()  # files with kernels: tried without compilation; None: all
    preloaded: tuple[str, ...] = ()  # imported once, before any mutant, by name

    def sources(self) -> list[Path]:
        """The files that are mutated."""
        found = [path for pattern in self.files for path in sorted(PACKAGE.glob(pattern))]
        return [path for path in found if path.name not in self.left_out]

    def tests_of(self, file: str) -> tuple[str, ...]:
        """Test files of the quick suite for a mutated file (below the root)."""
        return self.quick.get(below_package(file), self.otherwise)

    def without_compiler(self, file: str) -> bool:
        """Whether the quick suite of a file runs without compilation."""
        return self.interpreted is None or below_package(file) in self.interpreted


def below_package(file: str) -> str:
    """``ethbrake_marl/physics/kernel.py`` -> ``physics/kernel.py``."""
    return str(Path(file).relative_to(PACKAGE.name))


KERNEL = (
    "tests/physics/test_advance.py", "tests/physics/test_ties.py", "tests/golden/test_physics_hash.py",
    "tests/physics/test_completeness.py", "tests/physics/test_manufactured.py", "tests/physics/test_clusters.py",
    "tests/physics/test_against_exact.py", "tests/physics/test_obstacle.py",
)  # fmt: skip
PHYSICS = Suite(
    files=("physics/*.py", "harm.py"),
    quick={
        "physics/worlds.py": ("tests/physics/test_worlds.py", "tests/physics/test_advance.py"),
        'physics/kernel.py': (
            'tests/physics/test_obstacle.py',
            'tests/engine/test_obstacle.py',
            'tests/physics/test_events.py',
            'tests/physics/test_advance.py',
            'tests/physics/test_ties.py',
            'tests/golden/test_physics_hash.py',
            'tests/physics/test_completeness.py',
            'tests/physics/test_manufactured.py',
            'tests/physics/test_clusters.py',
            'tests/physics/test_against_exact.py',
            'tests/physics/test_segment.py',
            'tests/physics/test_forecast.py',
        ),
        'physics/batch.py': (
            'tests/physics/test_rows.py',
            'tests/engine/test_engine.py',
            'tests/engine/test_obstacle.py',
            'tests/physics/test_advance.py',
            'tests/golden/test_physics_hash.py',
            'tests/physics/test_parallel.py',
            'tests/physics/test_manufactured.py',
            'tests/physics/test_ties.py',
            'tests/physics/test_obstacle.py',
            'tests/physics/test_sampled_edges.py',
            'tests/physics/test_sampled.py',
            'tests/physics/test_sampled_input.py',
        ),
        "physics/compiling.py": ("tests/physics/test_compiled.py", "tests/physics/test_parallel.py"),
        "harm.py": ("tests/test_harm.py", "tests/physics/test_ledger.py", "tests/physics/test_obstacle.py"),
    },
    otherwise=KERNEL,
    whole=("tests/physics", "tests/golden/test_physics_hash.py", "tests/test_harm.py"),
    interpreted=None,
)  # fmt: skip

REWARDS = Suite(
    files=("rewards.py", "rewards.py", "harm.py"),
    quick={"harm.py": ("tests/test_objectives.py",)},
    otherwise=("tests/test_rewards.py", "tests/test_objectives.py"),
    whole=("tests/test_rewards.py", "tests/test_objectives.py", "tests/envs", "tests/contract"),
    preloaded=SCIENCE,
)

V2X = Suite(
    files=("scenario/v2x.py",),
    quick={},
    otherwise=("tests/scenario/test_v2x.py", "tests/scenario/test_schema.py"),
    whole=("tests/scenario/test_v2x.py", "tests/scenario", "tests/contract"),
    preloaded=SCIENCE,
)

STEPS = (
    "tests/test_rewards.py",
    "tests/engine/test_engine.py",
    "tests/envs/test_single.py",
    "tests/engine/test_obstacle.py",
)
ENGINE = Suite(
    files=("engine.py", "engine.py", "engine.py", "engine.py", "engine.py", "actions.py", "engine.py"),
    quick={
        "engine.py": (
            "tests/test_rewards.py",
            "tests/engine/test_engine.py",
            "tests/envs/test_single.py",
            "tests/engine/test_obstacle.py",
            "tests/engine/test_snapshot.py",
        ),
        "actions.py": ("tests/test_actions.py", *STEPS[2:3]),
    },
    otherwise=(*STEPS, "tests/envs/test_parallel.py", "tests/envs/test_sb3.py", "tests/envs/test_vector.py"),
    whole=(
        "tests/engine/test_engine.py",
        "tests/test_actions.py",
        "tests/engine/test_snapshot.py",
        "tests/envs",
        "tests/contract",
    ),
    interpreted=frozenset({"engine.py", "actions.py"}),
    preloaded=(*SCIENCE, *TORCH),
)

ABLATION = Suite(
    files=("studies/ablation.py",),
    quick={
        "studies/ablation.py": (
            "tests/studies/ablation/test_levels.py",
            "tests/studies/ablation/test_comparison.py",
            "tests/studies/ablation/test_joint_optimum.py",
            "tests/studies/ablation/test_measurement.py",
            "tests/studies/ablation/test_longer_lines.py",
        )
    },
    otherwise=("tests/studies/ablation/test_comparison.py", "tests/studies/ablation/test_ablate_command.py"),
    whole=("tests/studies/ablation",),
    preloaded=(*SCIENCE, *TORCH),
)

OF_ITEMS = ("tests/studies/reproduction/test_items.py",)
REPRODUCTION = Suite(
    files=("studies/reproduction.py",),
    quick={
        "studies/reproduction.py": (
            "tests/studies/reproduction/test_verdicts.py",
            "tests/studies/reproduction/test_folder.py",
            "tests/studies/reproduction/test_items.py",
            "tests/studies/reproduction/test_printed.py",
            "tests/studies/reproduction/test_full.py",
        )
    },
    otherwise=OF_ITEMS,
    whole=("tests/studies/reproduction", "tests/test_reproduction_page.py", "tests/cli/test_reproduce.py"),
    preloaded=SCIENCE,
)

TABLES = ("tests/evaluation/test_table.py", "tests/evaluation/test_rollout.py")
EVALUATION = Suite(
    files=(
        "evaluation/*.py", "figures.py",
    ),
    quick={
        "evaluation/statistics.py": ("tests/evaluation/test_statistics.py", "tests/evaluation/test_seed_statistics.py"),
        "evaluation/rollout.py": ("tests/evaluation/test_rollout.py", "tests/agents/test_team.py"),
        'evaluation/measures.py': (
            'tests/evaluation/test_rollout.py',
            'tests/evaluation/test_left_out.py',
            'tests/evaluation/shards/test_shards.py',
            'tests/evaluation/test_regret.py',
            'tests/evaluation/test_rescoring.py',
            'tests/test_objectives.py',
        ),
        'evaluation/episodes.py': ('tests/evaluation/test_record.py', 'tests/evaluation/test_film.py',),
        'evaluation/curves.py': (
            'tests/figures/test_criticality.py',
            'tests/figures/test_deceleration.py',
        ),
        'figures.py': (
            'tests/figures/test_criticality.py',
            'tests/figures/test_deceleration.py',
            'tests/figures/test_learning_curves.py',
        ),
        "evaluation/shield_modes.py": ("tests/evaluation/test_shield_modes.py",),
        "evaluation/results.py": ("tests/evaluation/test_report.py", "tests/evaluation/test_per_world.py"),
    },
    otherwise=TABLES,
    whole=("tests/evaluation", "tests/cli/test_commands.py"),
    left_out=frozenset({
        "__init__.py", "cells.py", "text.py", "report.py",
    }),  # what a figure or a page looks like is judged by eye
    preloaded=SCIENCE,
)  # fmt: skip

TRAINED = ("tests/learning/test_train.py", "tests/learning/test_teams.py", "tests/learning/test_resume.py")
LEARNING = Suite(
    files=("learning/*.py", "learning/algorithms/*.py", "policies/*.py", "files/store.py"),
    quick={
        "learning/runs.py": (
            "tests/learning/test_progress.py",
            "tests/learning/test_run_files.py",
            "tests/learning/test_event_files.py",
            "tests/learning/test_train.py",
            "tests/learning/test_teams.py",
            "tests/learning/test_resume.py",
            "tests/learning/test_sb3_policy.py",
        ),
        "policies.py": (
            "tests/policies/test_policy.py",
            "tests/learning/test_teams.py",
            "tests/policies/test_actor.py",
            "tests/policies/test_shipped.py",
        ),
        "files/store.py": (
            "tests/files/test_plain.py",
            "tests/policies/test_policy.py",
            "tests/learning/test_run_files.py",
        ),
        "learning/training.py": (
            "tests/learning/test_recipe.py",
            "tests/learning/test_algorithms.py",
            "tests/learning/test_training.py",
            "tests/learning/test_teams.py",
            "tests/learning/test_run_files.py",
            "tests/learning/test_event_files.py",
            "tests/learning/test_train.py",
            "tests/learning/test_resume.py",
        ),
        "learning/algorithms.py": ("tests/learning/test_teams.py",),
    },
    otherwise=TRAINED,
    whole=("tests/learning", "tests/cli/test_training_commands.py"),
    left_out=frozenset({"__init__.py", "benchmarl.py", "onnx.py"}),  # of other formats
    interpreted=frozenset({"policies.py"}),
    preloaded=(*SCIENCE, *TORCH),
)

SUITES = {
    "physics": PHYSICS,
    "rewards": REWARDS,
    "v2x": V2X,
    "engine": ENGINE,
    "ablation": ABLATION,
    "reproduction": REPRODUCTION,
    "evaluation": EVALUATION,
    "learning": LEARNING,
}


def suite_of(file: str) -> Suite:
    """The suite that tries the mutants of a file (below the root)."""
    return next(suite for suite in SUITES.values() if ROOT / file in suite.sources())
