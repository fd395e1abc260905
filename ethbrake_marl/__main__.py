"""``python -m ethbrake_marl``: the same as the command ``ethbrake``."""

from ethbrake_marl.cli.app import main

if __name__ == "__main__":
    main()
