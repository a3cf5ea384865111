"""An `argparse` parser that says what was probably meant."""

from __future__ import annotations

import argparse
import difflib
import re
import sys
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

CHOICES = re.compile(r"invalid choice: '(.*)' \(choose from (.*)\)")


class Parser(argparse.ArgumentParser):
    """As its base, but for errors, and for abbreviations: `--down` for `--downscale` would mean something else, or nothing, as soon as
    another option begins like that, so that it is an error which suggests the whole name.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**{"allow_abbrev": False, "formatter_class": _Formatter, **options})

    def parse_known_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> Any:      # type: ignore[override]
        """Look for unknown options first: an argument that is missing is often missing because of one."""
        args = sys.argv[1:] if args is None else list(args)
        for argument in args:
            name = argument.partition("=")[0]
            if argument == "--" or self._is_command(argument):
                break
            if name.startswith("--") and " " not in name and name not in self._option_string_actions:
                self.error(f"unknown option {name}{_meant(name, self._option_string_actions)}")
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """Print the usage, the error and the nearest of the choices, and exit with status 2."""
        found = CHOICES.search(message)
        if found:
            message += _meant(found[1], re.findall(r"[\w.-]+", found[2]))
        super().error(message)

    def _is_command(self, argument: str) -> bool:
        """Whether what follows is for the parser of a command."""
        return self._subparsers is not None and not argument.startswith("-")


class _Formatter(argparse.RawDescriptionHelpFormatter):
    """Descriptions and epilogs as they are written; options in a wide column."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=32)


def _meant(word: str, known: Iterable[str]) -> str:
    """The nearest of the known words as a question, if one is near: one that the word begins, or one that is spelt like it."""
    known = [name for name in known if name.startswith("--") == word.startswith("--")]
    near = [name for name in known if name.startswith(word)] or difflib.get_close_matches(word, known, n=1, cutoff=0.6)
    return f"; did you mean {near[0]}?" if near else ""
