"""Pulse generators that play SPAD trigger, gate and markers: PrawnDO, Teensy and Pulse Streamer."""
