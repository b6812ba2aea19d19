"""The parts of the emulated NI card in `nidaq`: its outputs, its tasks, the card itself, and properties."""
