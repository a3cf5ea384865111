"""The benchmark page is what its script makes of the results that are committed."""

import subprocess
import sys
from pathlib import Path

BENCH = Path(__file__).resolve().parents[2] / "bench"


def test_the_page_is_up_to_date() -> None:
    assert subprocess.run([sys.executable, BENCH / "page.py", "--check"]).returncode == 0, "run python bench/page.py"


def test_the_page_has_every_document() -> None:
    text = (BENCH / "results" / "README.md").read_text(encoding="utf-8")
    for path in [*(BENCH / "results").glob("*.json"), *(BENCH / "results").glob("2*.md")]:
        assert f"]({path.name})" in text, path.name
