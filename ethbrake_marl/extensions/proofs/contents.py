"""Contents of this extension: group -> name -> module of this folder and object."""

CONTENTS = {"measures": {"contact_avoidable": "measures:CONTACT_AVOIDABLE", "proven_harm": "measures:PROVEN_HARM"}}
