"""The measurements of the scripts, on scenes so small that only what does not depend on time can be asked for."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from test_bench_json import ENVIRONMENT

BYTES = """
import json, distributed
if __name__ == "__main__":
    print(json.dumps(distributed.measure(2, 2, 300, (32, 24), 1, 1)))
"""
ROW = """
import json, cpu
cpu.RIVAL_MS[32, 24, 50] = 1000, 2000
print(json.dumps(cpu.table([(32, 24, 50)])[0]))
"""


def test_ranks_send_the_bytes_of_the_formula(tmp_path: Path) -> None:
    script = tmp_path / "bytes.py"                             # a file: processes that are spawned import it
    script.write_text(BYTES, encoding="utf-8")
    done = subprocess.run([sys.executable, "-W", "ignore", script], env=ENVIRONMENT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    row = json.loads(done.stdout)
    assert row["bytes"] == row["formula"]
    assert row["elsewhere"] > 0
    assert row["loopback"] > row["bytes"]


def test_the_peak_of_memory_is_not_that_of_who_started_the_process() -> None:
    """As getrusage's is."""
    parent = "import subprocess, sys; held = b'x' * (700 << 20); subprocess.run([sys.executable, '-c', sys.argv[1]], check=True)"
    child = "import output; before = output.peak_memory(); held = b'x' * (100 << 20); print(before, output.peak_memory())"
    done = subprocess.run([sys.executable, "-c", parent, child], env=ENVIRONMENT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    before, after = map(int, done.stdout.split())
    assert 80 << 20 <= after - before <= 120 << 20


def test_rows_of_the_cpu_compare_as_many_exps() -> None:
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", ROW], env=ENVIRONMENT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    head, _, line, document = done.stdout.splitlines()
    row = json.loads(document)
    assert line.startswith("| 32x24 | 50 |")
    assert line.count("|") == head.count("|")
    assert row["pairs"] > 0
    ratios = [row[ours] / rival for ours, rival in zip(("forward_ms", "both_ms"), row["rival_ms"], strict=True)]
    assert ratios == pytest.approx([row["forward_exps"] / 3.4e9, row["both_exps"] / 6.8e9])         # the rival's exps in 1 and in 2 seconds
