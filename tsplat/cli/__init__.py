"""The command line: `tsplat fit`, `tsplat eval`, `tsplat render`, `tsplat convert`, `tsplat info`.

A command is a module here with `HELP` (one line), `add_arguments(parser)` and `run(options)`.
"""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections.abc import Sequence

import tsplat
from tsplat.cli import convert, eval, fit, info, render

INTERRUPTED = 130                    # the exit status of a shell's command that was stopped by Ctrl-C
COMMANDS = {"fit": fit, "eval": eval, "render": render, "convert": convert, "info": info}


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status: 0, 2 for an error (one line on stderr), 130 after Ctrl-C.

    Args:
        argv: the arguments, default `sys.argv[1:]`.
    """
    options = _parser().parse_args(argv)
    debug = options.debug or bool(os.environ.get("TSPLAT_DEBUG"))
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: print(f"tsplat: warning: {message}", file=sys.stderr)
            options.run(options)
    except KeyboardInterrupt as interrupt:
        print(f"tsplat: {interrupt or 'interrupted'}", file=sys.stderr)
        return INTERRUPTED
    except (ValueError, OSError, ArithmeticError, NotImplementedError, MemoryError, ImportError) as error:
        if debug:
            raise
        print(f"tsplat: error: {_text(error)}", file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="tsplat", description="Fit, render, convert and inspect scenes of Gaussian splats.")
    parser.add_argument("--version", action="version", version=f"tsplat {tsplat.__version__}")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument("--debug", action="store_true", help="show where an error came from (also: TSPLAT_DEBUG=1)")
    for name, command in COMMANDS.items():
        subparser = commands.add_parser(name, parents=[shared], help=command.HELP)
        subparser.set_defaults(run=command.run)
        command.add_arguments(subparser)
    return parser


def _text(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror is not None:
        return f"{error.filename}: {error.strerror}"
    return str(error) or type(error).__name__
