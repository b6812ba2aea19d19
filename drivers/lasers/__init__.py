"""Line lasers: Cobolt, OBIS and iBeam on serial ports, and `ttl`, one that is switched by hand and gated.

A driver makes a `drivers.interfaces.LineLaser` from its device's config. `serial_laser` has the base of serial ones.
"""
