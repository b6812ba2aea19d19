"""Entry point of `rig` and `python -m rig`.

Loading the program takes a moment. Ctrl-C while it loads ends it as at any other time: with one line and exit code 4.
"""

from spadrig.__main__ import end_unloaded


def main() -> None:
    """Load and run the command line. Ends the process with the command's exit code."""
    try:
        from rig.cli.main import main as command_line
    except KeyboardInterrupt:
        end_unloaded(4, "aborted", "aborted")
    command_line()


if __name__ == "__main__":
    main()
