"""Byte transports between a driver and its device: serial ports, USB and TCP, with deadlines and this project's
errors."""
