"""The parts that this extension adds: group -> name -> module of this folder and object."""

PARTS = {
    "measures": {
        "avoidable": "measures:AVOIDABLE",
        "proven_cost": "measures:PROVEN_COST",
        "proven_harm": "measures:PROVEN_HARM",
    }
}
