"""Transports that serve the firmware models to the real drivers: pseudo-terminals, TCP, an emulated USB bus."""
