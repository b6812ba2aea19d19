"""Transports of bytes between a driver and its device: serial ports, USB and TCP, with deadlines and our own errors."""
