"""Studies: what is trained, measured and shown by one command each."""
