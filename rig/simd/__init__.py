"""Vector operations for compiled kernels: sixteen lanes of 8, 16 or 32 bits, written as LLVM instructions."""
