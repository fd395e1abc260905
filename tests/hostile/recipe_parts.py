"""Wrong values in the parts of a recipe: its reward's terms, network, learning rate, evaluation, observation."""

from __future__ import annotations

# Category -> what stands in the recipe that is in order, and what is put in its place; each is refused.
RECIPE_PARTS: dict[str, tuple[str, tuple[str, ...]]] = {
    "terms of a reward": (
        "reward: {harm: 1.0}",
        tuple(
            f"reward: {each}"
            for each in (
                "{harm: -1}",
                "{harm: .nan}",
                "{harm: 1e400}",
                "{harm: true}",
                "{harm: [1]}",
                "{harm: 0}",
                "{harmm: 1}",
                "{harm: 1, harm: 1}",
                "{terms: 7}",
                "{terms: {nobody: 1}}",
                "{terms: {harm: 1}}",
                "{nobody: 1}",
                "{mine.py: 1}",
                "{'mine.py:term': 1}",
                "{__class__: 1}",
                "{weight: {harm: 1}}",
                "{'\u202eharm': 1}",
                '{"\\e[2J": 1}',
                "[harm]",
                "harm",
                "7",
            )
        ),
    ),
    "settings of a reward": (
        "{harm: 1.0}",
        (
            "{harm: 1, harm_count: both}",
            "{harm: 1, harm_count: [first]}",
            "{harm: 1, objective: nobody}",
            "{harm: 1, objective: 7}",
            '{harm: 1, objective: "weighted:1,-1,1"}',
            '{harm: 1, objective: "weighted:.nan,1,1"}',
            "{harm: 1, shaping_discount: 0}",
            "{harm: 1, shaping_discount: 2}",
            "{harm: 1, ttc_scale_s: 0}",
            "{harm: 1, ttc_scale_s: -.inf}",
            "{harm: 1, safety_buffer_m: -1}",
            "{harm: 1, distance_slope_per_m: 0}",
            "{harm: 1, target_gap_m: null}",
        ),
    ),
    "network": (
        "{policy: [8], value: [8]}",
        (
            "{policy: [], value: [8]}",
            "{policy: [8]}",
            "{policy: [0], value: [8]}",
            "{policy: [-8], value: [8]}",
            "{policy: [8.5], value: [8]}",
            "{policy: [1000000000], value: [8]}",
            f"{{policy: [{', '.join(['8'] * 99)}], value: [8]}}",
            "{policy: 8, value: 8}",
            "{policy: [8], value: [8], activation: eval}",
            "{policy: [8], value: [8], activation: torch.nn.ReLU}",
            "{policy: [8], value: [8], more: 1}",
            "[8, 8]",
        ),
    ),
    "learning rate": (
        "{start: 3.0e-4, end: 3.0e-5}",
        (
            "3.0e-4",
            "{start: 0, end: 3.0e-5}",
            "{start: -1, end: 3.0e-5}",
            "{start: 7, end: 3.0e-5}",
            "{start: .nan, end: 3.0e-5}",
            "{start: 3.0e-4}",
            "{start: 3.0e-4, end: 3.0e-5, schedule: lambda}",
            '{start: "3.0e-4", end: 3.0e-5}',
        ),
    ),
    "evaluation plan": (
        "{every_updates: 1, worlds: 10, seed: 7}",
        (
            "{every_updates: 0, worlds: 10, seed: 7}",
            "{every_updates: 1, worlds: 0, seed: 7}",
            "{every_updates: 1, worlds: 1000001, seed: 7}",
            "{every_updates: 1, worlds: 10, seed: -1}",
            "{every_updates: 1, worlds: 1e1, seed: 7.5}",
            "{every_updates: 1}",
            "{every_updates: 1, worlds: 10, seed: 7, file: /dev/zero}",
            "7",
        ),
    ),
    "observation": (
        "seed: 3",
        tuple(
            f"seed: 3\nobservation: {each}"
            for each in (
                "[]",
                "own",
                "[nobody]",
                "[own, own]",
                "[front_0]",
                "[front_100]",
                "[7]",
                "{own: 1}",
                "[own.]",
                "[/dev/zero]",
            )
        ),
    ),
    "algorithm": (
        "algorithm: ppo",
        tuple(
            f"algorithm: {each}"
            for each in (
                "nobody",
                "PPO",
                "7",
                "[ppo]",
                "{a: 1}",
                "true",
                '"ppo "',
                "mine.py:Ppo",
                "os.system",
                '"\\e[2J"',
                "x" * 5000,
            )
        ),
    ),
    "scheme": (
        "seed: 3",
        tuple(f"seed: 3\nscheme: {each}" for each in ("nobody", "7", "[single]", "Shared", '"\\u202e"')),
    ),
    "key of another algorithm": (
        "seed: 3",
        tuple(
            f"seed: 3\n{each}"
            for each in ("buffer_size: 100", "tau: 0.1", "counterfactuals: 0.5", "start: ppo@/dev/zero")
        ),
    ),
    "more than may be held": (
        "n_envs: 16",
        tuple(f"n_envs: {each}" for each in (10**9, 2**31, 2**63, 10**30, "1e12", 3_000_000)),
    ),
}
