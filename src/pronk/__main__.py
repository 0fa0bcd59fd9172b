"""`python -m pronk`: the command line, where the program `pronk` is not on the path."""

from pronk.cli.main import main

if __name__ == "__main__":
    main()
