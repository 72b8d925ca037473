"""`python -m steadylight`: the command line without an installed script."""

from steadylight.cli import main

if __name__ == "__main__":
    main()
