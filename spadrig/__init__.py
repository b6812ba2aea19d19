"""The project's own name: starts the command `rig`, and says whether other packages hide those of spadrig.

Input: the import path and the installed packages. Output: a sentence that names an intruder, or nothing. The other
packages (`rig`, `drivers`, `calibration`, `sim_backend`) have common names; this one has a name that nobody else has.
"""
