"""Processes of one group, in one start: importing torch takes seconds, so that each runs all checks of its number of ranks."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SECONDS = 300
"""How long all checks together may take on a busy machine; on a quiet one it is 10 to 20."""


def run_ranks(script: Path, ranks: int, folder: Path, *arguments: str, seconds: float = SECONDS) -> None:
    """Run `script rank ranks folder arguments` in as many processes. Where one of them fails the others, which wait for it, are ended at once.

    Raises:
        AssertionError: with what they printed; also after so many seconds.
    """
    paths = [str(ROOT), *(str(ROOT / p) for p in ("reference", "tests", "tests/compat"))]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    logs = [folder / f"{rank}.log" for rank in range(ranks)]
    processes = []
    try:
        for rank, log in enumerate(logs):
            with log.open("w") as out:
                command = [sys.executable, "-W", "ignore", str(script), str(rank), str(ranks), str(folder), *arguments]
                processes.append(subprocess.Popen(command, env=environment, stdout=out, stderr=subprocess.STDOUT))
        end = time.monotonic() + seconds
        codes = [p.poll() for p in processes]
        while None in codes and not any(codes) and time.monotonic() < end:
            time.sleep(0.05)
            codes = [p.poll() for p in processes]
    finally:
        for p in processes:
            p.kill()
            p.wait()
    texts = "\n".join(f"rank {r}: {log.read_text()[-3000:]}" for r, log in enumerate(logs))
    assert codes == [0] * ranks, f"exit codes {codes} (None: was still running)\n{texts}"
