"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {
    "measures": {
        "avoidable": "measures:AVOIDABLE",
        "proven_cost": "measures:PROVEN_COST",
        "proven_harm": "measures:PROVEN_HARM",
    }
}
