"""What several commands share."""

from __future__ import annotations

import argparse
import dataclasses
import typing
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from tsplat.fit import FitConfig, Quality
from tsplat.fit.evaluation import mean_quality
from tsplat.fit.output import read_config
from tsplat.scene.formats import FORMATS

SCENE = f"a scene file ({', '.join(item.suffix for item in FORMATS)})"


def add_fields(parser: argparse.ArgumentParser, names: Sequence[str]) -> None:
    """An option for each of these fields of `FitConfig`, which is not in the result if it was not given."""
    kinds = typing.get_type_hints(FitConfig)
    for item in dataclasses.fields(FitConfig):
        if item.name not in names:
            continue
        kind, text = kinds[item.name], item.metadata["help"]
        if item.default is None:                                                     # `kind | None`, of which the help says what None means
            kind = next(k for k in typing.get_args(kind) if k is not type(None))
        else:
            text = f"{text} (default: {item.default:g})" if kind is float else f"{text} (default: {item.default})"
        flag = "--" + item.name.replace("_", "-")
        if kind is bool:
            parser.add_argument(flag, action=argparse.BooleanOptionalAction, default=argparse.SUPPRESS, help=text)
        elif choices := typing.get_args(kind):
            parser.add_argument(flag, choices=choices, default=argparse.SUPPRESS, help=text)
        else:
            parser.add_argument(flag, type=kind, default=argparse.SUPPRESS, metavar=kind.__name__.upper(), help=text)


def config_of(options: argparse.Namespace, path: Path | None) -> FitConfig:
    """What the options say, on top of what the file says."""
    given = {item.name: getattr(options, item.name) for item in dataclasses.fields(FitConfig) if hasattr(options, item.name)}
    return FitConfig(**given) if path is None else dataclasses.replace(read_config(path), **given)


def add_device(parser: argparse.ArgumentParser) -> None:
    """The option `--device`, of which `device_of` makes a device."""
    parser.add_argument("--device", default="cpu", help="where to compute, as torch names it (default: cpu)")


def device_of(name: str) -> torch.device:
    """The device of that name; ValueError if torch knows none."""
    try:
        return torch.device(name)
    except RuntimeError:
        raise ValueError(f"--device: expected a device as torch names it, such as cpu or cuda; got {name!r}") from None


def print_mean(qualities: dict[str, Quality]) -> None:
    """One line, or none if there were no photos."""
    mean = mean_quality(qualities)
    if mean is not None:
        print(f"{len(qualities)} held-out photos: PSNR {mean.psnr:.2f} dB, SSIM {mean.ssim:.4f}")


def quantiles(values: Tensor, at: Sequence[float]) -> list[float]:
    """Of non-empty `[n]`, to the nearest value."""
    ordered = values.sort().values
    return [float(ordered[round(q * (len(ordered) - 1))]) for q in at]
