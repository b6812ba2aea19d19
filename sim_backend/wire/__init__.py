"""Emulators of the real devices' wires: pure models of the firmware, served to the real drivers by thin transports."""
