"""Galvo scanners driven by the Helios and LaserCube laser DACs.

A driver takes a waveform in mirror commands and gives a `drivers.interfaces.BeamScanner` with an exact point clock.
`dac_scanner` holds what laser DACs share, `galvo` the limits of the mirror behind them and paths within these.
"""
