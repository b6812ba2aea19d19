"""Entry point of `rig` and `python -m rig`.

Loading the program takes a moment. Ctrl-C while it loads ends it as at any other time: with one line and exit code 4.
"""

import sys


def main() -> None:
    """Load and run the command line. Ends the process with the command's exit code."""
    try:
        from rig.cli.main import main as command_line
    except KeyboardInterrupt:
        sys.stderr.write("aborted\n")
        sys.exit(4)
    command_line()


if __name__ == "__main__":
    main()
