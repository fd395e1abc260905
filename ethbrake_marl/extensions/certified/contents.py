"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {
    "agents": {"e_v2x_bm.estimated": "estimating:ESTIMATED_E_V2X_BM"},
    "shields": {
        "robust": "robust:ROBUST",
        "step.estimated": "estimating:ESTIMATED_STEP",
        "episode.estimated": "estimating:ESTIMATED_EPISODE",
    },
}
