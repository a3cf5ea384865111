"""Of all scripts that measure: `--json`, with which a document is all that stdout gets."""

from __future__ import annotations

import argparse
import contextlib
import json
import sys
from typing import Any


def add_json(parser: argparse.ArgumentParser) -> None:
    """The option."""
    parser.add_argument("--json", action="store_true", help="print one JSON document on stdout; what is else to be read goes to stderr")


def printing(as_json: bool) -> contextlib.AbstractContextManager[Any]:
    """Within this, what is printed goes to stderr if `--json` was given."""
    return contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext()


def print_json(content: Any) -> None:
    """One document; ValueError for what JSON has no number for."""
    print(json.dumps(content, indent=1, allow_nan=False))
