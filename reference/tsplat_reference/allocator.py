"""Memory that was freed stays with the process, so that arrays of the same size in the next step do not fault in every page anew.

glibc gives freed memory back to the system from a size on that it learns: twice the largest block freed so far, at most 64 MB. Until then
a frame of 100,000 splats has 12,000 page faults, a tenth of its time on one thread and a quarter on two, which wait for each other there.
"""

from __future__ import annotations

import torch

LEARNT = (32 << 20) - (1 << 16)
"""Bytes of the largest block from which glibc still learns (DEFAULT_MMAP_THRESHOLD_MAX, less its own header)."""


def keep_freed_memory() -> None:
    """Let glibc learn its largest size at once, from a block that is freed before it is touched: it takes 10 us and no memory.

    Up to 64 MB of free memory then stay with the process. Settings of the user (MALLOC_TRIM_THRESHOLD_ and the like) remain as they are,
    and other allocators do not mind.
    """
    torch.empty(LEARNT, dtype=torch.uint8)
