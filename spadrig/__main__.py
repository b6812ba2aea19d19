"""Entry point of the command `rig`, and of `python -m spadrig`.

It is in the package `spadrig`, because another package `rig` may have taken the place of ours.
"""

import json
import sys


def main() -> None:
    """Run `rig`. Ends the process with the command's exit code; 2, with one sentence, if packages are not spadrig's."""
    from spadrig.names import intruder

    found = intruder()
    if found is not None:
        sys.stderr.write(f"error: {found}\n")
        if "--json" in sys.argv:
            sys.stdout.write(json.dumps({"error": {"code": 2, "problems": [found]}}) + "\n")
        sys.exit(2)
    from rig.__main__ import main as command

    command()


if __name__ == "__main__":
    main()
