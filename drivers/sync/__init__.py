"""Pulse generators that play gate and markers: the PrawnDO."""
