"""Exchange of recordings with other programs: `rig import`, `rig export` (docs/how-to/exchange.md)."""
