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
    """``ethbrake_marl/physics/impact.py`` -> ``physics/impact.py``."""
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
        "physics/compiled.py": ("tests/physics/test_compiled.py",),
        "physics/obstacle.py": ("tests/physics/test_obstacle.py", "tests/test_engine_hazard.py"),
        "physics/packed.py": ("tests/physics/test_packed.py", "tests/test_engine.py", "tests/test_engine_hazard.py"),
        "physics/parallel.py": ("tests/physics/test_parallel.py",),
        "physics/sampled.py": (
            "tests/physics/test_sampled_edges.py", "tests/physics/test_sampled.py",
            "tests/physics/test_sampled_input.py", "tests/physics/test_obstacle.py",
        ),
        "physics/events.py": ("tests/physics/test_events.py", *KERNEL),
        "physics/segment.py": (*KERNEL[:3], "tests/physics/test_segment.py", *KERNEL[3:]),
        "physics/forecast.py": ("tests/physics/test_forecast.py", "tests/physics/test_obstacle.py"),
        "harm.py": ("tests/test_harm.py", "tests/physics/test_ledger.py", "tests/physics/test_obstacle.py"),
        "physics/advance.py": (
            "tests/physics/test_advance.py", "tests/golden/test_physics_hash.py", "tests/physics/test_parallel.py",
            "tests/physics/test_manufactured.py", "tests/physics/test_ties.py", "tests/physics/test_obstacle.py",
        ),
    },
    otherwise=KERNEL,
    whole=("tests/physics", "tests/golden/test_physics_hash.py", "tests/test_harm.py"),
    left_out=frozenset({"__init__.py", "tolerances.py"}),  # the tolerances are the yardstick
    interpreted=None,
)  # fmt: skip

REWARDS = Suite(
    files=("rewards.py", "objectives.py"),
    quick={"objectives.py": ("tests/test_objectives.py",)},
    otherwise=("tests/test_rewards.py", "tests/test_objectives.py"),
    whole=("tests/test_rewards.py", "tests/test_objectives.py", "tests/envs", "tests/contract"),
    preloaded=SCIENCE,
)

V2X = Suite(
    files=("v2x.py",),
    quick={},
    otherwise=("tests/test_v2x.py", "tests/scenario/test_schema.py"),
    whole=("tests/test_v2x.py", "tests/scenario", "tests/contract"),
    preloaded=SCIENCE,
)

STEPS = ("tests/test_rewards.py", "tests/test_engine.py", "tests/envs/test_single.py", "tests/test_engine_hazard.py")
ENGINE = Suite(
    files=("engine.py", "starts.py", "stepping.py", "actions.py", "snapshots.py"),
    quick={
        "stepping.py": STEPS,
        "actions.py": ("tests/test_actions.py", *STEPS[2:3]),
        "snapshots.py": ("tests/test_snapshots.py",),
    },
    otherwise=(*STEPS, "tests/envs/test_parallel.py", "tests/envs/test_sb3.py", "tests/envs/test_vector.py"),
    whole=("tests/test_engine.py", "tests/test_actions.py", "tests/test_snapshots.py", "tests/envs", "tests/contract"),
    interpreted=frozenset({"stepping.py", "actions.py"}),
    preloaded=(*SCIENCE, *TORCH),
)

ABLATION = Suite(
    files=("ablation/*.py",),
    quick={
        "ablation/levels.py": ("tests/ablation/test_levels.py",),
        "ablation/comparison.py": ("tests/ablation/test_comparison.py",),
        "ablation/joint_optimum.py": ("tests/ablation/test_joint_optimum.py",),
        "ablation/longer_lines.py": ("tests/ablation/test_longer_lines.py",),
        "ablation/tables.py": ("tests/ablation/test_comparison.py",),
        "ablation/measurement.py": ("tests/ablation/test_measurement.py", "tests/ablation/test_comparison.py"),
    },
    otherwise=("tests/ablation/test_comparison.py", "tests/ablation/test_ablate_command.py"),
    whole=("tests/ablation", "tests/test_cooperation_page.py"),
    left_out=frozenset({"__init__.py", "figures.py"}),  # what a figure looks like is judged by eye
    preloaded=(*SCIENCE, *TORCH),
)

TABLES = ("tests/evaluation/test_table.py", "tests/evaluation/test_rollout.py")
EVALUATION = Suite(
    files=("evaluation/*.py",),
    quick={
        "evaluation/statistics.py": ("tests/evaluation/test_statistics.py",),
        "evaluation/seed_statistics.py": ("tests/evaluation/test_seed_statistics.py",),
        "evaluation/seed_curves.py": ("tests/evaluation/test_seed_curves.py",),
        "evaluation/rollout.py": ("tests/evaluation/test_rollout.py", "tests/agents/test_team.py"),
        "evaluation/regret.py": ("tests/evaluation/test_regret.py",),
        "evaluation/record.py": ("tests/evaluation/test_record.py",),
        "evaluation/rescoring.py": ("tests/evaluation/test_rescoring.py", "tests/test_objectives.py"),
        "evaluation/per_world.py": ("tests/evaluation/test_per_world.py",),
        "evaluation/criticality.py": ("tests/evaluation/test_criticality.py",),
        "evaluation/deceleration_curve.py": ("tests/evaluation/test_deceleration_curve.py",),
        "evaluation/shield_modes.py": ("tests/evaluation/test_shield_modes.py",),
        "evaluation/sampling_study.py": ("tests/evaluation/test_sampling_study.py",),
        "evaluation/output_files.py": ("tests/evaluation/test_report.py", "tests/evaluation/test_per_world.py"),
    },
    otherwise=TABLES,
    whole=("tests/evaluation", "tests/cli/test_commands.py"),
    left_out=frozenset({
        "__init__.py", "figures.py", "figure_style.py", "operating_figure.py", "robustness_figure.py",
        "shield_modes_figure.py", "trajectories.py", "rendering.py", "report.py",
    }),  # what a figure or a page looks like is judged by eye
    preloaded=SCIENCE,
)  # fmt: skip

TRAINED = ("tests/learning/test_train.py", "tests/learning/test_teams.py", "tests/learning/test_resume.py")
LEARNING = Suite(
    files=("learning/*.py",),
    quick={
        "learning/course.py": ("tests/learning/test_course.py",),
        "learning/recipe.py": ("tests/learning/test_recipe.py",),
        "learning/bundle.py": ("tests/learning/test_bundle.py",),
        "learning/manifest.py": ("tests/learning/test_bundle.py",),
        "learning/networks.py": ("tests/learning/test_bundle.py", "tests/learning/test_forward.py"),
        "learning/forward.py": ("tests/learning/test_forward.py",),
        "learning/squash.py": ("tests/learning/test_forward.py",),
        "learning/strict_json.py": ("tests/learning/test_bundle.py", "tests/learning/test_run_files.py"),
        "learning/event_files.py": ("tests/learning/test_event_files.py", "tests/learning/test_resume.py"),
        "learning/kept_training.py": ("tests/learning/test_kept_training.py", "tests/learning/test_teams.py"),
        "learning/progress_table.py": ("tests/learning/test_run_files.py", *TRAINED),
        "learning/run_directory.py": ("tests/learning/test_run_files.py", *TRAINED),
        "learning/independent.py": ("tests/learning/test_teams.py",),
        "learning/central_critic.py": ("tests/learning/test_teams.py",),
        "learning/schemes.py": ("tests/learning/test_teams.py", "tests/learning/test_recipe.py"),
        "learning/team_file.py": ("tests/learning/test_teams.py",),
        "learning/policy_team.py": ("tests/learning/test_teams.py",),
        "learning/sb3_policy.py": ("tests/learning/test_sb3_policy.py", *TRAINED),
        "learning/shipped.py": ("tests/learning/test_shipped.py",),
        "learning/checkpoint.py": ("tests/learning/test_resume.py",),
        "learning/stop_signal.py": ("tests/learning/test_resume.py",),
    },
    otherwise=TRAINED,
    whole=("tests/learning", "tests/cli/test_training_commands.py"),
    left_out=frozenset({"__init__.py", "benchmarl_task.py", "legacy_import.py", "onnx_export.py"}),  # of other formats
    interpreted=frozenset({"learning/forward.py", "learning/squash.py"}),
    preloaded=(*SCIENCE, *TORCH),
)

SUITES = {
    "physics": PHYSICS,
    "rewards": REWARDS,
    "v2x": V2X,
    "engine": ENGINE,
    "ablation": ABLATION,
    "evaluation": EVALUATION,
    "learning": LEARNING,
}


def suite_of(file: str) -> Suite:
    """The suite that tries the mutants of a file (below the root)."""
    return next(suite for suite in SUITES.values() if ROOT / file in suite.sources())
