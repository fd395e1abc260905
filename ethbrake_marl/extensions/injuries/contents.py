"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {
    "measures": {
        "injury": "measures:INJURY",
        "injury_lr4s": "measures:LR4S",
        "injury_reference": "measures:REFERENCE",
        "injury_gidas": "measures:GIDAS",
        "delta_v_mps": "measures:DELTA_V",
    },
    "objectives": {"injury": "curves:INJURY_OBJECTIVE"},
}
