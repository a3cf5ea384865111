"""What a fit leaves behind: curves, the sheet of held-out photos, the turntable, numbers for TensorBoard."""

from collections.abc import Callable
from pathlib import Path

import torch

from tsplat.fit import FitConfig, fit, to_writer
from tsplat.fit.plot import HEIGHT, WIDTH, curves
from tsplat.fit.report import History, write_sheet
from tsplat.fit.turntable import turntable
from tsplat.scene import Capture, read_image, write_image

Make = Callable[..., FitConfig]


def test_turntable_goes_round_at_the_photos_distance(capture: Capture, config: Make, tmp_path: Path) -> None:
    cameras = turntable(capture, 12)
    eyes = torch.stack([-(c.viewmats[:3, :3].T @ c.viewmats[:3, 3]) for c in cameras])
    torch.testing.assert_close(eyes.mean(0)[[0, 2]], torch.zeros(2), atol=0.02, rtol=0)      # around the middle of the scene
    distance = eyes[:, [0, 2]].norm(dim=1)
    assert 2.5 < float(distance.min()) <= float(distance.max()) < 3.3                       # between the two rings of cameras
    assert (eyes[:, 1] < -0.7).all()                                                        # above the ground: y is down
    fit(capture, config(steps=2, video=4), tmp_path, progress=False)
    assert (tmp_path / "turntable.gif").read_bytes().count(b"\x21\xF9\x04") == 4


def test_curves_show_their_values() -> None:
    image = curves([("LOSS", [0, 5, 10], [3.0, 1.0, 2.0]), ("PSNR DB", [], []), ("SPLATS", [1], [float("inf")])])
    assert image.shape == (3 * HEIGHT, WIDTH, 3)
    line = (image[:HEIGHT] - torch.tensor([0.1, 0.35, 0.75])).abs().amax(-1) < 1e-6
    rows, columns = line.nonzero().unbind(1)
    assert rows[columns.argmin()] == rows.min()                        # starts at the top, the greatest,
    assert abs(int(columns[rows.argmax()]) - int(columns.float().mean().round())) <= 2      # is lowest in the middle,
    assert abs(int(rows[columns.argmax()]) - (int(rows.min()) + int(rows.max())) // 2) <= 2      # and ends half way
    assert not ((image[HEIGHT:] - torch.tensor([0.1, 0.35, 0.75])).abs().amax(-1) < 1e-6).any()


def test_history_is_of_means_and_short() -> None:
    history = History()
    for step in range(1, 2001):
        history.add(step, 2000, float(step), 2.0 * step, 7)
    assert len(history.rows) == 500
    assert history.rows[0] == [4.0, 2.5, 5.0, 7.0]


def test_sheet(tmp_path: Path) -> None:
    paths = []
    for i in range(20):
        paths.append(tmp_path / f"{i}.png")
        write_image(paths[-1], torch.cat([torch.full((4, 600 + i, 3), 0.5), torch.full((4, 600 + i, 3), 0.6)], dim=1))
    write_sheet(tmp_path / "sheet.png", paths)
    sheet = read_image(tmp_path / "sheet.png").float() / 255
    assert sheet.shape == (7 * 2, 3 * 240, 3)                          # every third of 20, reduced
    assert (sheet[:, 300] - 0.6).abs().max() < 1e-6
    assert (sheet[:, 600] - 4 * 25 / 255).abs().max() < 0.01           # 0.5 is 128 in a file, 0.6 is 153


def test_numbers_for_tensorboard(capture: Capture, config: Make) -> None:
    class Writer:
        scalars: list[tuple[str, float, int]] = []      # noqa: RUF012

        def add_scalar(self, tag: str, value: float, step: int) -> None:
            self.scalars.append((tag, value, step))

    fit(capture, config(steps=2), progress=False, callbacks=[to_writer(Writer())])
    assert [(tag, step) for tag, _, step in Writer.scalars] == [(tag, step) for step in (1, 2) for tag in ("loss", "psnr", "splats")]
    assert Writer.scalars[2][1] == 200
