"""`python -m embomatrix.cli` is the `embomatrix` command: child processes start through it, independent of PATH."""

from embomatrix.cli.main import main

if __name__ == "__main__":
    main()
