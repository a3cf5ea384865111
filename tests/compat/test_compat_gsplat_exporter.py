"""gsplat's `export_splats`."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from compare import assert_close
from torch import Tensor

from tsplat import Gaussians
from tsplat.compat.gsplat import export_splats
from tsplat.scene.gaussians import SH_C0


def splats(n: int = 6) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(1)
    return {"means": torch.randn(n, 3, generator=g), "scales": torch.randn(n, 3, generator=g) - 2, "quats": torch.randn(n, 4, generator=g),
            "opacities": torch.randn(n, generator=g), "sh0": torch.randn(n, 1, 3, generator=g), "shN": torch.randn(n, 8, 3, generator=g)}


def test_a_ply_that_is_exported_loads(tmp_path: Path) -> None:
    """Bit by bit, without the splat that is not finite."""
    args = splats()
    args["scales"][2, 1] = math.nan
    path = tmp_path / "scene.ply"
    data = export_splats(**args, format="ply", save_to=str(path))
    assert path.read_bytes() == data
    scene, rest = Gaussians.load(path), torch.arange(6) != 2
    for name, got in (("means", scene.means), ("scales", scene.log_scales), ("quats", scene.quats), ("opacities", scene.opacity_logits),
                      ("sh0", scene.sh0), ("shN", scene.sh_rest)):
        assert torch.equal(got, args[name][rest]), name


def test_a_splat_file_has_32_bytes_a_row() -> None:
    """Position and scales as they are, colour, opacity and rotation in bytes."""
    args = splats()
    data = torch.frombuffer(bytearray(export_splats(**args, format="splat")), dtype=torch.uint8).view(6, 32)
    floats = data[:, :24].contiguous().view(torch.float32)
    assert torch.equal(floats[:, :3], args["means"])
    assert_close(floats[:, 3:], args["scales"].exp(), 1e-6)
    color = torch.cat([args["sh0"][:, 0] * SH_C0 + 0.5, args["opacities"].sigmoid()[:, None]], 1).clamp(0, 1)
    assert (data[:, 24:28] / 255 - color).abs().max() <= 0.51 / 255
    quats = torch.nn.functional.normalize(args["quats"], dim=1)
    assert ((data[:, 28:].float() - 128) / 128 - quats).abs().max() <= 1 / 128


def test_a_compressed_ply_loads(tmp_path: Path) -> None:
    """To the 11 bits of a coordinate, in some order."""
    args, path = splats(), tmp_path / "scene.compressed.ply"
    export_splats(**args, format="ply_compressed", save_to=str(path))
    scene = Gaussians.load(path)
    distances = torch.cdist(scene.means.detach(), args["means"])
    assert sorted(distances.argmin(1).tolist()) == list(range(6))
    assert distances.amin(1).max() <= (args["means"].amax() - args["means"].amin()) / 1000
    assert scene.sh_degree == 2


def test_export_refuses() -> None:
    with pytest.raises(ValueError, match="format: expected one of"):
        export_splats(**splats(), format="obj")
    with pytest.raises(ValueError, match="sh0: expected shape"):
        export_splats(**(splats() | {"sh0": torch.zeros(6, 3)}))
