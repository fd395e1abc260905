"""Entry point of ``python -m ethbrake_marl``: the command line, for when the script ``ethbrake`` is not on the path."""

from ethbrake_marl.cli.app import main

if __name__ == "__main__":
    main()
