"""`Controls`: what one visitor can choose, beside the picture."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
import viser

from tsplat.camera import Camera
from tsplat.pictures import MODES
from tsplat.scene import write_image
from tsplat.viewer.loop import RenderLoop
from tsplat.viewer.schedule import Frame, Wish
from tsplat.viewer.view import Pixels, Settings
from tsplat.viewer.viewpoint import Viewpoint, stance
from tsplat.viewer.views import Views

MAX_SIDE = 2560          # pixels of a picture; screens may have more, of which each costs as much
JPEG_QUALITY = 90
NO_PHOTO = "–"
NARROWEST, WIDEST = 5.0, 120.0


class Controls:
    """The controls of one open page, and its picture.

    Callbacks are coroutines, as viser runs these one after the other, but for the one that takes long.

    Args:
        client: the page.
        loop: which draws for it.
        views: where it can go.
        settings: what it begins with.
        sh_degree: the highest that can be chosen; None for spheres.
    """

    def __init__(self, client: viser.ClientHandle, loop: RenderLoop, views: Views, settings: Settings, sh_degree: int | None) -> None:
        self._client, self._loop, self._views, self._settings = client, loop, views, settings
        self._status = client.gui.add_markdown("Waiting for the first picture")
        with client.gui.add_folder("Picture"):
            self._add_settings(client.gui, sh_degree)
        with client.gui.add_folder("Camera"):
            self._add_camera(client.gui)
        self._visitor = loop.enter(self._show)
        client.camera.on_update(self.look)

    def close(self) -> None:
        """The page was closed."""
        self._loop.leave(self._visitor)

    def _add_settings(self, gui: viser.GuiApi, sh_degree: int | None) -> None:
        initial = self._settings
        self._mode = gui.add_dropdown("Show", MODES, initial_value=initial.mode)
        self._size = gui.add_slider("Splat size", min=0.05, max=2.0, step=0.05, initial_value=initial.splat_size)
        self._background = gui.add_rgb("Background", _bytes(initial.background))
        inputs: list[Any] = [self._mode, self._size, self._background]
        self._degree = self._antialiased = None
        if sh_degree:
            degree = sh_degree if initial.sh_degree is None else min(initial.sh_degree, sh_degree)
            self._degree = gui.add_slider("SH degree", min=0, max=sh_degree, step=1, initial_value=degree,
                                          hint="How much colours change with the direction from which they are seen")
            inputs.append(self._degree)
        if sh_degree is not None:
            self._antialiased = gui.add_checkbox("Antialiased", initial.antialiased, hint="For scenes that were fitted with it")
            inputs.append(self._antialiased)
        for handle in inputs:
            handle.on_update(self._choose)
        gui.add_button("Save picture", icon=viser.Icon.DOWNLOAD).on_click(self._save)

    def _add_camera(self, gui: viser.GuiApi) -> None:
        self._fov = gui.add_slider("Field of view", min=NARROWEST, max=WIDEST, step=0.5, initial_value=_degrees(self._client.camera.fov),
                                   hint="Vertical, in degrees")
        self._fov.on_update(self._zoom)
        names = list(self._views.photos)
        if names:
            self._photo = gui.add_dropdown("Photo", [NO_PHOTO, *names])
            self._photo.on_update(self._go_to_photo)
            gui.add_button_group(" ", ("previous", "next")).on_click(self._step)
        gui.add_button("Back to the start").on_click(self._go_to_start)

    async def _choose(self, _: Any) -> None:
        background = self._background.value
        self._settings = Settings(self._mode.value, self._size.value, None if self._degree is None else self._degree.value,
                                  (background[0] / 255, background[1] / 255, background[2] / 255),
                                  self._antialiased is not None and self._antialiased.value)
        await self.look(self._client.camera)

    async def look(self, camera: viser.CameraHandle) -> None:
        """Ask for the picture of the page's camera."""
        self._loop.wish(self._visitor, Wish(_viewpoint(camera), self._settings))

    async def _zoom(self, event: viser.GuiEvent[Any]) -> None:
        if event.client is not None:                      # else it was `_go`
            self._client.camera.fov = math.radians(self._fov.value)

    async def _go_to_photo(self, _: Any) -> None:
        if self._photo.value != NO_PHOTO:
            self._go(self._views.photos[self._photo.value])

    async def _step(self, event: viser.GuiEvent[Any]) -> None:
        """To the next photo, or the one before."""
        names = self._photo.options[1:]
        now = names.index(self._photo.value) if self._photo.value in names else -1
        self._photo.value = names[(now + 1) % len(names) if event.target.value == "next" else (max(now, 0) - 1) % len(names)]   # type: ignore[misc]

    async def _go_to_start(self, _: Any) -> None:
        self._go(self._views.start)

    def _go(self, camera: Camera) -> None:
        place = self._client.camera
        there = stance(camera, self._views.middle, self._views.up, place.aspect)
        with self._client.atomic():
            place.position, place.look_at, place.up_direction = map(np.array, there[:3])
            place.fov = there.fov
            self._fov.value = _degrees(there.fov)         # type: ignore[misc]  # viser: it can be assigned

    def _show(self, frame: Frame) -> None:
        self._client.scene.set_background_image(frame.pixels, format="jpeg", jpeg_quality=JPEG_QUALITY)
        height, width = frame.pixels.shape[:2]
        full = frame.wish.viewpoint
        size = f"{width} x {height}" if frame.divisor == 1 else f"{width} x {height} of {full.width} x {full.height}"
        self._status.content = f"{size}, {1000 * frame.seconds:.0f} ms ({1 / frame.seconds:.0f} per second)"

    def _save(self, _: Any) -> None:
        """Draw anew, without the losses of JPEG, in a thread of viser's."""
        wish = self._visitor.wish
        pixels = None if wish is None else self._loop.sharp(wish)
        if pixels is not None:
            self._client.send_file_download("tsplat.png", _png(pixels), save_immediately=True)


def _viewpoint(camera: viser.CameraHandle) -> Viewpoint:
    scale = min(1.0, MAX_SIDE / max(1, camera.image_width, camera.image_height))
    return Viewpoint(tuple(camera.wxyz.tolist()), tuple(camera.position.tolist()), camera.fov,
                     *(max(1, round(scale * side)) for side in (camera.image_width, camera.image_height)))


def _png(pixels: Pixels) -> bytes:
    """A PNG file."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.png"
        write_image(path, torch.from_numpy(pixels).float() / 255)
        return path.read_bytes()


def _degrees(fov: float) -> float:
    """As the slider can show them."""
    return round(min(max(math.degrees(fov), NARROWEST), WIDEST), 1)


def _bytes(color: tuple[float, float, float]) -> tuple[int, int, int]:
    red, green, blue = (round(255 * value) for value in color)
    return red, green, blue
