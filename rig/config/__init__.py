"""Rig configs: their model with units and limits, the files they come from, and the messages about mistakes in them.

Input: YAML and options of a command. Output: a validated `rig.config.models.RigConfig`.
"""
