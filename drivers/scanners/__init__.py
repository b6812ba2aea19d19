"""Galvo drives: the Helios and LaserCube laser DACs.

A driver takes a waveform in mirror commands and gives a `drivers.interfaces.BeamScanner` with an exact point clock.
`dac_scanner` is what laser DACs share, `galvo` the limits of the mirror behind them.
"""
