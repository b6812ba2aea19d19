"""Byte transports between a driver and its device: serial ports and USB, with deadlines and this project's
errors."""
