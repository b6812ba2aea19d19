"""Device side of spadrig: interfaces, errors, units, SPB1 blocks, the block ring and the registry of kinds."""
