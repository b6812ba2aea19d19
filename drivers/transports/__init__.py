"""Byte transports between a driver and its device: serial ports, USB and TCP. Calls that wait have deadlines.

Input: the address of a device, and bytes for it. Output: its bytes, or one of `drivers.errors` for each way in which a
connection can fail. `endpoints` finds emulated devices too; `tap` records the traffic.
"""
