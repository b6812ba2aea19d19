"""Drivers through real Linux kernels in virtual machines."""
