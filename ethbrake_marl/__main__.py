"""Entry point of ``python -m ethbrake_marl``, which runs the same command line as the script ``ethbrake``."""

from ethbrake_marl.cli.app import main

if __name__ == "__main__":
    main()
