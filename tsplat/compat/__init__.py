"""Drop-ins: code written for gsplat, for diff_gaussian_rasterization (Inria) or for Pulsar (PyTorch3D) runs with one import line changed.

`tsplat.compat.gsplat`, `tsplat.compat.inria` and `tsplat.compat.pulsar` translate arguments and results; the core renders.
"""
