"""Boards and the rigs that see them, drawn without the simulator: what the calibration is judged on."""
