"""Galvo scanners driven by the Helios and LaserCube laser DACs.

A driver takes a waveform in mirror commands and gives a `drivers.interfaces.BeamScanner` with an exact point clock.
`dac_scanner` holds what laser DACs and the mirror behind them share.
"""
