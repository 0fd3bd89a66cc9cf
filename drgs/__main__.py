"""`python -m drgs`: the command where it is not on the path."""

from drgs.cli import main

if __name__ == "__main__":
    main()
