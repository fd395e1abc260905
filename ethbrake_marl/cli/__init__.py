"""The command ``ethbrake``: parse arguments, call the package, print the results."""
