"""What several commands share."""

from __future__ import annotations

import argparse
import dataclasses
import json
import typing
from collections.abc import Sequence
from typing import Any

import torch

from tsplat.fit import FitConfig, Quality
from tsplat.fit.evaluation import mean_quality
from tsplat.scene.formats import FORMATS

AXES = {sign + axis: tuple(float(f"{sign}1") * (axis == a) for a in "xyz") for sign in ("", "-") for axis in "xyz"}
REFINED = "held-out photos with their poses refined"
SCENE = f"a scene file ({', '.join(item.suffix for item in FORMATS)})"


def add_fields(parser: argparse.ArgumentParser, names: Sequence[str] | None = None) -> None:
    """An option for each field of `FitConfig`, under its topic, or for those of these names. What is not given is not in the result."""
    kinds = typing.get_type_hints(FitConfig)
    topics: dict[str, argparse._ArgumentGroup] = {}
    for item in dataclasses.fields(FitConfig):
        if names is not None and item.name not in names:
            continue
        topic = item.metadata["topic"]
        if topic not in topics:
            topics[topic] = parser.add_argument_group(topic)
        _add_field(topics[topic], item, kinds[item.name])


def _add_field(group: argparse._ArgumentGroup, item: dataclasses.Field[Any], kind: Any) -> None:
    text = item.metadata["help"]
    if item.default is None:                                                         # `kind | None`, of which the help says what None means
        kind = next(k for k in typing.get_args(kind) if k is not type(None))
    else:
        text = f"{text} (default: {item.default:g})" if kind is float else f"{text} (default: {item.default})"
    flag = "--" + item.name.replace("_", "-")
    if kind is bool:
        group.add_argument(flag, action=argparse.BooleanOptionalAction, default=argparse.SUPPRESS, help=text)
    elif choices := typing.get_args(kind):
        group.add_argument(flag, choices=choices, default=argparse.SUPPRESS, help=text)
    else:
        group.add_argument(flag, type=kind, default=argparse.SUPPRESS, metavar=kind.__name__.upper(), help=text)


def config_of(options: argparse.Namespace, base: FitConfig) -> FitConfig:
    """What the options say, on top of another config."""
    given = {item.name: getattr(options, item.name) for item in dataclasses.fields(FitConfig) if hasattr(options, item.name)}
    return dataclasses.replace(base, **given)


def add_device(parser: argparse.ArgumentParser) -> None:
    """The option `--device`, of which `device_of` makes a device."""
    parser.add_argument("--device", default="cpu", help="where to compute, as torch names it (default: cpu)")


def device_of(name: str, *, used: bool = True) -> torch.device:
    """The device of that name; ValueError if torch knows none, or, where it is to be `used`, cannot use it here."""
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ValueError(f"--device: expected a device as torch names it, such as cpu or cuda; got {name!r}") from None
    try:
        torch.empty(0, device=device if used else None)
    except (RuntimeError, AssertionError) as error:                                  # AssertionError: torch was built without it
        raise ValueError(f"--device: {name} cannot be used here: {str(error).partition(chr(10))[0]}") from None
    return device


def add_json(parser: argparse.ArgumentParser) -> None:
    """The option `--json`: then a command prints one document by `print_json`, and nothing else."""
    parser.add_argument("--json", action="store_true", help="print one JSON document, and nothing else on stdout")


def print_json(content: dict[str, Any]) -> None:
    """As `json.tool` indents it; ValueError for what JSON has no number for."""
    print(json.dumps(content, indent=2, allow_nan=False))


def print_mean(qualities: dict[str, Quality], kind: str = "held-out photos") -> None:
    """One line, or none if there were no photos."""
    mean = mean_quality(qualities)
    if mean is not None:
        print(f"{len(qualities)} {kind}: PSNR {mean.psnr:.2f} dB, SSIM {mean.ssim:.4f}")


def print_qualities(qualities: dict[str, Quality], kind: str = "held-out photos") -> None:
    """A line for each photo, and that of the mean."""
    for name, quality in qualities.items():
        print(f"{name}: PSNR {quality.psnr:.2f} dB, SSIM {quality.ssim:.4f}")
    print_mean(qualities, kind)
