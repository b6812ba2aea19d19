"""Line lasers on serial ports: Cobolt and OBIS.

A driver makes a `drivers.interfaces.LineLaser` from its device's config. `serial_laser` holds what the drivers share.
"""
