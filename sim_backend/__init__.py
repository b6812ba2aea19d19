"""The simulated rig: worlds, effects, photons and simulated devices."""
