"""`python -m drivers.guard SOCKET PAGE`: started by `drivers.guard.client.Guard`, by nobody else."""

import os
import sys

from drivers.guard.process import main

code = main(sys.argv[1:])
sys.stderr.flush()
os._exit(code)  # a thread that hangs in a lost port is left behind
