"""The parts of the emulated NI card in `nidaq`: its outputs, its tasks, the card itself, and properties.

Input: the calls that `nidaq` passes on, and the time. Output: the voltages and levels at the card's outputs, as
functions of time, and the errors of NI-DAQmx.
"""
