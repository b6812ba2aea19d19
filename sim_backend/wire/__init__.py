"""Emulators of the real devices' wires: pure models of the firmware, served to the real drivers by thin transports.

Input: bytes from the real drivers. Output: the bytes that the devices would answer, frames of the simulated scene among
them. `firmware` has the models, `serve` the transports; `emulated_world` puts them in front of a scene.
"""
