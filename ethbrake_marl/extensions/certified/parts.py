"""The parts that this extension adds: group -> name -> module of this folder and object."""

PARTS = {
    "agents": {"e_v2x_bm.estimated": "estimating:E_V2X_BM"},
    "shields": {
        "robust": "robust:ROBUST",
        "step.estimated": "estimating:STEP",
        "episode.estimated": "estimating:EPISODE",
    },
}
