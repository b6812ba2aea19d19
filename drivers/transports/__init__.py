"""Byte transports between a driver and its device: serial ports, USB and TCP. Calls that wait have deadlines."""
