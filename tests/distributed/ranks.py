"""A process of a group: `python ranks.py rank ranks folder module...` runs the checks of these modules, each rank the same."""

from __future__ import annotations

import datetime
import importlib
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
import torch.distributed as dist


@dataclass
class Ranks:
    """Where this process is, and a folder that all ranks have."""

    rank: int
    count: int
    group: Any
    folder: Path = Path()


def expect(kind: type[Exception], text: str, call: Callable[[], object]) -> None:
    """An error of this kind that begins with the text."""
    with pytest.raises(kind, match="^" + re.escape(text)):
        call()


def main() -> None:
    """Run all functions of the modules that have the name `check_...`. An error ends this process; the other ranks would wait for it."""
    rank, count, folder = int(sys.argv[1]), int(sys.argv[2]), Path(sys.argv[3])
    dist.init_process_group("gloo", init_method=f"file://{folder / 'store'}", rank=rank, world_size=count, timeout=datetime.timedelta(seconds=60))
    for module in map(importlib.import_module, sys.argv[4:]):
        for name, check in list(vars(module).items()):         # a list: torch.compile adds to them
            if name.startswith("check_"):
                torch.manual_seed(0)
                print(module.__name__, name, flush=True)            # the last line before an error says where
                check(Ranks(rank, count, dist.group.WORLD, folder))
    dist.destroy_process_group()


if __name__ == "__main__":
    main()
