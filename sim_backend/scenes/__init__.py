"""What stands in front of the simulated rig."""
