"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {
    "agents": {
        "idm": "controllers:IDM",
        "acc": "controllers:ACC",
        "cacc": "controllers:CACC",
        "rss": "controllers:RSS",
        "r157_human": "controllers:R157_HUMAN",
        "r157_fsm": "controllers:R157_FSM",
        "aeb": "controllers:AEB",
        "human": "human:HUMAN",
        "synchronised": "synchronised:AGENT",
        "field": "controllers:FIELD",
    },
    "measures": {"ttc_s": "measures:TTC", "drac_mps2": "measures:DRAC", "whose_front": "measures:WHOSE_FRONT"},
}
