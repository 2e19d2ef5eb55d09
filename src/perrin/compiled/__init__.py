"""Kernels in C, where perrin was built with a compiler; numpy does the same work without them."""

from perrin.compiled.loading import compiled_kernels, kernels_in_use

__all__ = ["compiled_kernels", "kernels_in_use"]
