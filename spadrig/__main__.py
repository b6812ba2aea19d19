"""Entry point of the command `rig`, and of `python -m spadrig`.

It is in the package `spadrig`, because another package `rig` may have taken the place of ours.
"""

import json
import signal
import sys
from typing import NoReturn


def main() -> None:
    """Run `rig`. Ends the process with the command's exit code; 2, with one sentence, if packages are not spadrig's."""
    try:
        from spadrig.names import intruder

        found = intruder()
        if found is not None:
            end_unloaded(2, found, f"error: {found}")
        from rig.__main__ import main as command
    except KeyboardInterrupt:
        end_unloaded(4, "aborted", "aborted")
    command()


def end_unloaded(code: int, problem: str, line: str) -> NoReturn:
    """End the process before the program is loaded: with a line on stderr, and with --json as one JSON object too."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C must not take the place of the exit code
    sys.stderr.write(f"{line}\n")
    if "--json" in sys.argv:
        sys.stdout.write(json.dumps({"error": {"code": code, "problems": [problem]}}) + "\n")
    sys.exit(code)


if __name__ == "__main__":
    main()
