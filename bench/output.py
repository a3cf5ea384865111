"""Of all scripts that measure: `--json`, with which a document is all that stdout gets, what the figures in it hold for, and memory."""

from __future__ import annotations

import argparse
import contextlib
import datetime
import json
import platform
import resource
import subprocess
import sys
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).resolve().parents[1]


def environment(device: str) -> dict[str, Any]:
    """Kind of device and its name, versions, threads, command, commit and date."""
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=ROOT, capture_output=True, text=True).stdout.strip()
    machine, versions = f"{platform.machine()} CPU", {"torch": torch.__version__}
    if device == "cuda":
        import triton

        machine, versions["triton"] = torch.cuda.get_device_name(), triton.__version__
    script = Path(sys.argv[0]).resolve()
    command = ["python", script.relative_to(ROOT).as_posix() if script.is_relative_to(ROOT) else script.name, *sys.argv[1:]]
    return {"device": device, "machine": machine, **versions, "threads": torch.get_num_threads(), "command": " ".join(command),
            "commit": commit, "date": datetime.date.today().isoformat()}


def memory(name: str) -> int:
    """Bytes, from what Linux knows of this process: VmRSS is what it holds, VmHWM the most that it held."""
    return next(int(line.split()[1]) * 1024 for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name))


def peak_memory() -> int:
    """Bytes: the most that this process held so far. On Linux not by getrusage, which begins with the peak of the process that started this one."""
    if sys.platform == "linux":
        return memory("VmHWM")
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def add_json(parser: argparse.ArgumentParser) -> None:
    """The option."""
    parser.add_argument("--json", action="store_true", help="print one JSON document on stdout; what is else to be read goes to stderr")


def printing(as_json: bool) -> contextlib.AbstractContextManager[Any]:
    """Within this, what is printed goes to stderr if `--json` was given."""
    return contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext()


def print_json(content: Any) -> None:
    """One document; ValueError for what JSON has no number for."""
    print(json.dumps(content, indent=1, allow_nan=False))
