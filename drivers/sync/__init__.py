"""Pulse generators that play SPAD trigger, gate and markers: PrawnDO, Teensy and Pulse Streamer.

Input: the config of the device, and a program: pulses and how often they repeat. Output: these pulses at the board's
outputs. Each driver is a `drivers.interfaces.SyncSource`; `board` has the common base.
"""
