"""Counts the cores that this process may use."""

import os

VARIABLE = "PYTHON_CPU_COUNT"
"""Environment variable that limits the number, as Python 3.13 and later read it themselves."""


def cores() -> int:
    """Number of cores that this process may use, at least 1: the environment variable `PYTHON_CPU_COUNT` if that is a
    whole number, else the number that the system allows it."""
    told = os.environ.get(VARIABLE, "")
    if told.isdecimal():
        return max(1, int(told))
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
