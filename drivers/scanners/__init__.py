"""Galvo scanners driven by the Helios and LaserCube laser DACs.

Each driver is a `drivers.interfaces.BeamScanner` with an exact point clock. `dac_scanner` holds what laser DACs share;
`galvo` has the limits of the mirror behind them, and paths that keep within these limits.
"""
