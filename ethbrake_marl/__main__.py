"""Run the command line: ``python -m ethbrake_marl``."""

from ethbrake_marl.cli.app import main

if __name__ == "__main__":
    main()
