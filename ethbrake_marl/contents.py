"""Contents of the core: group -> name -> module and object, loaded when the name is first used."""

CONTENTS = {
    "agents": {
        "coast": "agents.scripts:COAST_ENTRY",
        "full_brake": "agents.scripts:FULL_BRAKE_ENTRY",
        "constant": "agents.scripts:CONSTANT_ENTRY",
        "policy": "agents.trained:POLICY",
        "team": "agents.trained:TEAM",
        "ppo": "agents.trained:PPO",
        "sac": "agents.trained:SAC",
        "vine-paper": "agents.trained:VINE_PAPER",
        "e_v2x_bm": "agents.e_v2x_bm:E_V2X_BM",
        "ladder": "agents.scripts:LADDER",
    },
    "shields": {"step": "shields.step:STEP", "episode": "shields.algorithm_1:EPISODE"},
    "terms": {"intervention": "shields.shield:intervention"},
    "measures": {
        "worst5": "evaluation.measures:WORST5",
        "pushed_mps": "evaluation.measures:PUSHED_MPS",
        "pushed_m": "evaluation.measures:PUSHED_M",
        "drove_towards": "evaluation.measures:DROVE_TOWARDS",
        "still_moving": "evaluation.measures:STILL_MOVING",
    },
}
