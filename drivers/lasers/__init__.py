"""Line lasers on serial ports: Cobolt and OBIS.

A driver takes its device's config and gives a `drivers.interfaces.LineLaser`. `serial_laser` holds what they share.
"""
