"""Recordings from and for other programs: `rig import`, `rig export` (docs/how-to/exchange.md)."""
