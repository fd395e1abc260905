"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {"measures": {"avoidable": "measures:AVOIDABLE", "proven_harm": "measures:PROVEN_HARM"}}
