"""Coarse to fine: which steps compare at half the size, and that halves show the same."""

from collections.abc import Callable

import pytest
import torch

from tsplat import Camera
from tsplat.fit import FitConfig
from tsplat.fit.coarse import SMALLEST, at_step, halved

SIZE = 2 * SMALLEST


def camera(width: int, height: int) -> Camera:
    return Camera(torch.eye(4), torch.tensor([[50.0, 0, width / 2], [0, 60.0, height / 2], [0, 0, 1]]), width, height)


@pytest.mark.parametrize(("step", "size", "half"), [(0, SIZE, True), (9, SIZE, True), (10, SIZE, False), (0, SIZE - 1, False)])
def test_the_first_steps_compare_halves_of_large_photos(config: Callable[..., FitConfig], step: int, size: int, half: bool) -> None:
    photo, cam = at_step(config(steps=20, coarse=0.5), step, torch.rand(size, SIZE, 3), camera(SIZE, size))
    assert photo.shape[:2] == (cam.height, cam.width) == ((SIZE // 2, SIZE // 2) if half else (size, SIZE))


def test_a_half_sees_the_same_view() -> None:
    photo, cam = halved(torch.full((7, 10, 3), 0.25), camera(10, 7))
    torch.testing.assert_close(photo, torch.full((4, 5, 3), 0.25))
    torch.testing.assert_close(cam.Ks, torch.tensor([[25.0, 0, 2.5], [0, 60 * 4 / 7, 2.0], [0, 0, 1]]))


def test_what_does_not_count_has_no_say() -> None:
    photo = torch.zeros(4, 4, 4)
    photo[:, ::2] = torch.tensor([0.5, 0.25, 1.0, 1.0])
    small, _ = halved(photo, camera(4, 4))
    torch.testing.assert_close(small, torch.tensor([0.5, 0.25, 1.0, 0.5]).expand(2, 2, 4))
