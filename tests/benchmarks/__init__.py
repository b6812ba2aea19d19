"""Figures that `rig bench` does not show, each a program: python -m tests.benchmarks.NAME. Asserts nothing."""
