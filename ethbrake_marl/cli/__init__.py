"""The command ``ethbrake``: parse, call, print."""
