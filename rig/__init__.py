"""The application: config, plan, acquisition, reconstruction, command line.

Input: a config and the options of a command, or a recording. Output: depth maps, recordings, calibrations and reports.
Importing this package gives numba a folder for compiled kernels.
"""

from rig.kernel_cache import prepare_kernels

prepare_kernels()
