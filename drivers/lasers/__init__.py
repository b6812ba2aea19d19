"""Line lasers: Cobolt, OBIS and iBeam on serial ports, and `ttl`, a laser without a port that is switched by hand.

Input: the config of the device, and a power in watts. Output: a `drivers.interfaces.LineLaser` and its status. While
a laser is armed and not paused, it shines whenever the gate is high. `serial_laser` has the base class of lasers on
serial ports.
"""
