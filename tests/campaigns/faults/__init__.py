"""Faults of devices, frames, computer and people, two or three at once, in scans whose undisturbed result is known."""
