"""`python -m drivers.guard SOCKET PAGE` (file descriptors) runs the guard; only `drivers.guard.client` does so."""

import os
import sys

from drivers.guard.process import main

code = main(sys.argv[1:])
sys.stderr.flush()
os._exit(code)  # a thread that hangs in a lost port is left behind
