"""Drivers, scans and the guard under random faults on emulated wires."""
