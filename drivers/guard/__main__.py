"""`python -m drivers.guard SOCKET PAGE` runs the guard. Only `drivers.guard.client.Guard` starts it."""

import os
import sys

from drivers.guard.process import main

code = main(sys.argv[1:])
sys.stderr.flush()
os._exit(code)  # a thread that hangs in a lost port is left behind
