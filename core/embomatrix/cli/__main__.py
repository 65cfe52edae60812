"""`python -m embomatrix.cli` is the `embomatrix` command: child processes are started by it, whatever the PATH."""

from embomatrix.cli.main import main

if __name__ == "__main__":
    main()
