"""Tests of `rig.stream`."""
