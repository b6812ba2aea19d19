"""The application of spadrig: config, plan, acquisition, reconstruction, command line.

Input: a config and the options of a command, or a recording. Output: depth maps, recordings, calibrations and reports.
Importing this package gives numba a folder for compiled kernels. It raises ImportError if another package hides one of
this project.
"""

from rig.kernel_cache import prepare_kernels
from spadrig.names import require_own_names

require_own_names()
prepare_kernels()
