"""Galvo scanners behind a Helios, LaserCube or Ether Dream laser DAC, or behind an NI card.

Input: the config of the device, and a waveform of mirror commands and markers. Output: that waveform at the DAC's
outputs. Each driver is a `drivers.interfaces.BeamScanner`. `dac_scanner` is the common part of all of them; `galvo` has
the limits of the mirror behind the DAC, and paths that keep within these limits.
"""
