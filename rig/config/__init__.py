"""Rig configs: their model with units and limits, the files they come from, and the messages about mistakes in them.

Enters: YAML, options of a command. Leaves: a validated `rig.config.models.RigConfig`.
"""
