"""The command line: `tsplat fit`, `eval`, `compare`, `render`, `view`, `convert` and `info`.

A command is a module here with `HELP` (one line), `USAGE`, `DESCRIPTION`, `EXAMPLES`, `add_arguments(parser)` and `run(options)`.
"""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections.abc import Sequence

import torch

import tsplat
from tsplat.cli import compare, convert, eval, fit, info, render, torchrun, view
from tsplat.cli.parser import Parser

INTERRUPTED = 130                    # the exit status of a shell's command that was stopped by Ctrl-C
UNREAD = 141                         # and of one that SIGPIPE ended: nobody reads what it writes
COMMANDS = {"fit": fit, "eval": eval, "compare": compare, "render": render, "view": view, "convert": convert, "info": info}
DESCRIPTION = "Fit, render, view, compare, convert and inspect scenes of Gaussians and spheres."
EPILOG = f"""
examples:
  tsplat fit --synthetic -o out                        a first fit, without data
  tsplat fit capture -o out --downscale 4              photos posed by COLMAP
  tsplat render out/scene.ply -o turn.gif --orbit 60   or .png, .mp4; or depth
  tsplat view out/scene.ply                            in a web page
  tsplat info out/scene.ply --json                     nothing but JSON

exit status:
  0    done
  2    an error, which the last line on stderr says
  {INTERRUPTED}  stopped by Ctrl-C; `tsplat fit` leaves a checkpoint, from which the
       same command goes on
  {UNREAD}  what reads the output has ended, as in `tsplat info scene.ply | head -1`

`tsplat COMMAND --help` tells all about a command.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command and return its exit status: 0, 2 for an error (one line on stderr), 130 after Ctrl-C, 141 if nobody reads stdout.

    Args:
        argv: the arguments, default `sys.argv[1:]`.

    Raises:
        SystemExit: after `--help`, with status 0, and for a wrong command line, with 2.
    """
    for stream in (sys.stdout, sys.stderr):
        if getattr(stream, "errors", None) == "strict":                    # for names of files that the terminal has no letters for
            stream.reconfigure(errors="backslashreplace")                  # type: ignore[union-attr]
    try:
        try:
            return _run(_parser().parse_args(argv))
        finally:
            sys.stdout.flush()                                             # now, while it can still be caught that nobody reads it
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())     # for the flush when Python ends
        return UNREAD


def _run(options: argparse.Namespace) -> int:
    debug = options.debug or bool(os.environ.get("TSPLAT_DEBUG"))
    try:
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: print(f"tsplat: warning: {message}", file=sys.stderr)
            if options.command != "fit" and torchrun.ranks() > 1:
                raise ValueError(f"tsplat {options.command}: expected one process; got {torchrun.ranks()} of torchrun, among which only "
                                 "`tsplat fit` shares its work")
            options.run(options)
    except KeyboardInterrupt as interrupt:
        print(f"tsplat: {str(interrupt) or 'interrupted'}", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        raise
    except (ValueError, OSError, ArithmeticError, NotImplementedError, MemoryError, ImportError) as error:
        if debug:
            raise
        print(f"tsplat: error: {_text(error)}", file=sys.stderr)
        return 2
    except RuntimeError as error:
        if debug or not _out_of_memory(error):
            raise
        print(f"tsplat: error: not enough memory: {_text(error).partition(chr(10))[0]}", file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = Parser(prog="tsplat", usage="tsplat COMMAND ...", description=DESCRIPTION, epilog=EPILOG)
    parser.add_argument("--version", action="version", version=f"tsplat {tsplat.__version__}")
    commands = parser.add_subparsers(title="commands", prog="tsplat", required=True, metavar="COMMAND")
    for name, command in COMMANDS.items():
        subparser = commands.add_parser(name, help=command.HELP, usage=command.USAGE, description=command.DESCRIPTION.strip(),
                                        epilog=f"examples:\n{command.EXAMPLES.strip(chr(10))}")
        command.add_arguments(subparser)
        subparser.add_argument("--debug", action="store_true", help="show where an error came from (also: TSPLAT_DEBUG=1)")
        subparser.set_defaults(run=command.run, command=name)
    return parser


def _out_of_memory(error: RuntimeError) -> bool:
    """On a CPU torch has no type of its own for it."""
    return isinstance(error, torch.OutOfMemoryError) or "DefaultCPUAllocator" in str(error)


def _text(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None and error.strerror is not None:
        return f"{error.filename}: {error.strerror}"
    return str(error) or type(error).__name__
