"""Line lasers: Cobolt, OBIS and iBeam on serial ports, and `ttl`, one that is switched by hand and gated.

Input: the config of the device, and a power in watts. Output: a `drivers.interfaces.LineLaser` and its status. While
it is armed and not paused, it shines whenever the gate is high. `serial_laser` has the base of serial ones.
"""
