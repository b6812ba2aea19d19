"""`python -m rig` is `rig`."""

from rig.cli.main import main

if __name__ == "__main__":
    main()
