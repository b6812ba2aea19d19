"""Rig configs: their model with units and limits, the files they come from, and what is said of a mistake in one.

Enters: YAML, options of a command. Leaves: a validated `rig.config.models.RigConfig`.
"""
