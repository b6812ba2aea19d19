"""What all tests run with."""

import os

# Set before numpy is loaded. Workers that share a few cores would spend most of a product of small matrices waiting for
# each other's threads of BLAS.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
