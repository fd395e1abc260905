"""The command-line program ``ethbrake``: parse arguments, call the package, and print the results."""
