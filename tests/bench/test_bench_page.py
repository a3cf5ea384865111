"""The benchmark page is what its script makes of the results that are committed."""

import subprocess
import sys
from pathlib import Path

import pytest

BENCH = Path(__file__).resolve().parents[2] / "bench"


def test_the_page_is_up_to_date() -> None:
    assert subprocess.run([sys.executable, BENCH / "page.py", "--check"]).returncode == 0, "run python bench/page.py"


def test_the_page_has_every_document() -> None:
    text = (BENCH / "results" / "README.md").read_text(encoding="utf-8")
    for path in [*(BENCH / "results").glob("*.json"), *(BENCH / "results").glob("2*.md")]:
        assert f"]({path.name})" in text, path.name


def test_fits_on_a_gpu_are_one_table(monkeypatch: pytest.MonkeyPatch) -> None:
    """As `bench/quality/gpu.py` has them, without those that failed."""
    monkeypatch.syspath_prepend(BENCH)
    import page

    fit = {"psnr": 31.0, "ssim": 0.9, "splats": 5, "wall_s": 90.0, "splats_per_s": 2345678.0, "curve": [[3.0, 20.0]]}
    run = {"rasterizer": "gsplat", "capture": "fox", "config": {"steps": 7000}, "fits": [fit], "profile": "of 3 ms",
           "to_quality": {"s": 30, "psnr": 30.5}}
    ((_, columns, rows),) = page.sections({"runs": [run, {"error": "no memory"}]})
    assert page.table(columns, rows)[2:] == [
        "| fox | steps 7000 | gsplat | 30 s to 30.5 dB | 31.00 | 0.9000 | 5 | 90 | 2,345,678 | 20.0 after 3 s | of 3 ms |"]
