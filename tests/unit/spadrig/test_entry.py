"""The entry point while the program loads."""

import subprocess
import sys

_INTERRUPTED_TWICE = """
import atexit, os, signal, sys
import spadrig.names

def interrupted():
    raise KeyboardInterrupt

spadrig.names.intruder = interrupted
atexit.register(os.kill, os.getpid(), signal.SIGINT)
from spadrig.__main__ import main
main()
"""


def test_a_second_interrupt_while_the_interpreter_ends_does_not_take_the_place_of_the_exit_code() -> None:
    done = subprocess.run([sys.executable, "-c", _INTERRUPTED_TWICE], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (4, "", "aborted\n")
