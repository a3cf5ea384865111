"""Triton kernels and their launchers: a file per stage, the twin of the reference file of that name. Reached from `tsplat.ops` alone."""
