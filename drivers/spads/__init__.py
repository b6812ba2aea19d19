"""SPAD arrays: the SPAD512S over TCP, and any sensor that streams SPB1 blocks over USB.

Input: the config of the device, and a `SpadRequest`. Output: blocks of packed frames in the ring, and the number of
lost ones. Each driver is a `drivers.interfaces.SpadArray`; `orientation` turns frames of sensors mounted sideways.
"""
