"""The application: config, plan, acquisition, reconstruction, command line."""

from rig.kernel_cache import prepare

prepare()
