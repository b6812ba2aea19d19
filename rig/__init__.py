"""The application: config, plan, acquisition, reconstruction, command line."""

from rig.kernel_cache import prepare_kernels

prepare_kernels()
