"""The scenes in front of the simulated rig."""
