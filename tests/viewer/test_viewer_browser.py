"""The page in a real browser: what is on the screen is what the library renders."""

import contextlib
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from compare import assert_same_bits

import tsplat.viewer.training
from tsplat import Camera, rasterize
from tsplat.fit import FitConfig, FitResult, Step, fit
from tsplat.scene import Capture, Gaussians, read_image
from tsplat.viewer import RenderLoop, Settings, Views, draw_view

pytest.importorskip("viser", reason="the viewer's page needs viser: pip install 'tsplat[viewer]'")
sync_api = pytest.importorskip("playwright.sync_api", reason="tests of the viewer's page need playwright: pip install 'tsplat[test]'")

from tsplat.viewer.page import Page, training_page  # noqa: E402

Wait = Callable[..., None]
WIDTH, HEIGHT = 800, 480
SEEN = (slice(220, HEIGHT), slice(0, 440))       # rows and columns that no control or notice of the page covers, whatever the fonts
LEVELS = 1.2
"""Mean difference of screen and render, in 1/255: JPEG leaves up to 0.94 on these pictures; three pixels to the side are 1.3 and more."""
SWITCHES = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
            "--disable-component-update", "--disable-sync"]


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium."""
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if path is None:
        pytest.skip("tests of the viewer's page need Chromium (chromium, chromium-browser or google-chrome)")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=SWITCHES)
        yield browser
        browser.close()


class Screen:
    """An open page."""

    def __init__(self, browser: Any, url: str, wait: Wait, folder: Path) -> None:
        self.tab = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        self.tab.set_default_timeout(60_000)
        self.requests: list[str] = []
        self.tab.on("request", lambda request: self.requests.append(request.url))
        self.tab.goto(f"{url}?fixedDpr=1")                   # else viser lowers the resolution on a slow machine
        self._wait, self._file = wait, folder / "screen.png"

    def until(self, condition: Callable[[], object], what: str) -> None:
        """Wait, while the browser's events are handled."""
        self._wait(condition, what, lambda _: self.tab.wait_for_timeout(50))

    def differs(self, want: np.ndarray[Any, Any]) -> float:
        """Mean difference of what is on the screen from a picture of its size."""
        self.tab.screenshot(path=self._file)
        shot = read_image(self._file).numpy()[..., :3]
        return float(np.abs(shot[SEEN].astype(float) - want[SEEN]).mean())

    def shows(self, want: np.ndarray[Any, Any], what: str) -> None:
        """Wait until this is on the screen."""
        self.until(lambda: self.differs(want) < LEVELS, what)

    def slide(self, label: str, part: float) -> float:
        """Click on a slider, so far along it, where it is not yet, and return its new value."""
        slider = self._input(label)
        thumb, box = slider.locator("[role=slider]"), slider.bounding_box()
        before = thumb.get_attribute("aria-valuenow")
        slider.click(position={"x": part * box["width"], "y": box["height"] / 2})
        self.until(lambda: thumb.get_attribute("aria-valuenow") != before, f"another value of {label}")
        return float(thumb.get_attribute("aria-valuenow"))

    def choose(self, label: str, option: str) -> None:
        """Choose from a list."""
        self._input(label).click()
        self.tab.get_by_role("option", name=option, exact=True).click()

    def _input(self, label: str) -> Any:
        return self.tab.locator("[id='" + self.tab.get_by_text(label, exact=True).get_attribute("for") + "']")


@contextlib.contextmanager
def served(scene: Gaussians, views: Views, settings: Settings | None = None) -> Iterator[str]:
    with RenderLoop() as loop, Page(loop, views, settings, scene.sh_degree, port=0) as page:
        loop.show(scene)
        yield page.url


@pytest.fixture
def views(camera: Camera, capture: Capture) -> Views:
    """Begins at `camera`, offers the photos of `capture`."""
    return Views(camera, torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]), Views.of_capture(capture).photos)


def on_screen(scene: Gaussians, camera: Camera, **settings: Any) -> np.ndarray[Any, Any]:
    """What a page of the window's size shows of what this camera sees, computed apart from the viewer's own conversions."""
    f = float(camera.Ks[1, 1]) * min(HEIGHT / camera.height, WIDTH / camera.width * float(camera.Ks[0, 0]) / float(camera.Ks[1, 1]))
    K = torch.tensor([[f, 0.0, WIDTH / 2], [0.0, f, HEIGHT / 2], [0.0, 0.0, 1.0]])
    return draw_view(scene, Camera(camera.viewmats, K, WIDTH, HEIGHT), Settings(**settings))


def test_a_page_shows_the_scene_and_asks_nobody_else(browser: Any, gaussians: Gaussians, views: Views, wait: Wait, tmp_path: Path) -> None:
    with served(gaussians, views) as url:
        assert url.startswith("http://127.0.0.1:")
        screen = Screen(browser, url, wait, tmp_path)
        want = on_screen(gaussians, views.start)
        screen.shows(want, "the first picture")
        for wrong in (want[::-1], want[:, ::-1], np.zeros_like(want)):                 # which the tolerance tells from the right one
            assert screen.differs(wrong) > 3 * LEVELS
        assert all(request.startswith((url, f"blob:{url}", "data:")) for request in screen.requests)
        screen.until(lambda: screen.tab.get_by_text(f"{WIDTH} x {HEIGHT}, ").count(), "the line that says the resolution")
        screen.tab.close()


def test_a_photos_camera_shows_what_rasterize_renders(browser: Any, gaussians: Gaussians, views: Views, wait: Wait, tmp_path: Path) -> None:
    g, photo = gaussians, "view_003.png"
    with served(gaussians, views) as url:
        screen = Screen(browser, url, wait, tmp_path)
        screen.shows(on_screen(gaussians, views.start), "the first picture")
        screen.choose("Photo", photo)
        f = HEIGHT / 24 * float(views.photos[photo].Ks[1, 1])                          # the window is wider than the photo
        camera = Camera(views.photos[photo].viewmats, torch.tensor([[f, 0.0, WIDTH / 2], [0.0, f, HEIGHT / 2], [0.0, 0.0, 1.0]]), WIDTH, HEIGHT)
        with torch.no_grad():
            image = rasterize(g.means, g.quats, g.scales, g.opacities, g.sh, camera, sh_degree=2).image
        screen.shows((255 * image.clamp(0, 1)).round().numpy(), "the photo's view")
        screen.tab.get_by_text("next", exact=True).click()
        screen.shows(on_screen(gaussians, views.photos["view_004.png"]), "the next photo's view")
        screen.tab.get_by_text("Back to the start").click()
        screen.shows(on_screen(gaussians, views.start), "the first picture again")
        screen.tab.close()


def test_controls_change_the_picture_and_save_it(browser: Any, gaussians: Gaussians, views: Views, wait: Wait, tmp_path: Path) -> None:
    with served(gaussians, views) as url:
        screen = Screen(browser, url, wait, tmp_path)
        before = on_screen(gaussians, views.start)
        screen.shows(before, "the first picture")
        size = screen.slide("Splat size", 0.2)
        assert 0.3 < size < 0.6
        small = on_screen(gaussians, views.start, splat_size=size)
        assert np.abs(small[SEEN].astype(float) - before[SEEN]).mean() > 3 * LEVELS
        screen.shows(small, "smaller splats")
        with screen.tab.expect_download() as download:
            screen.tab.get_by_text("Save picture").click()
        download.value.save_as(tmp_path / "saved.png")
        saved = read_image(tmp_path / "saved.png").numpy()
        assert saved.shape == small.shape
        assert np.abs(saved.astype(int) - small).max() <= 2                            # not JPEG; the camera went through float32 in the page
        assert screen.slide("SH degree", 0.0) == 0
        screen.shows(on_screen(gaussians, views.start, splat_size=size, sh_degree=0), "the colours of degree 0")
        screen.choose("Show", "depth")
        screen.shows(on_screen(gaussians, views.start, splat_size=size, sh_degree=0, mode="depth"), "depth")
        screen.choose("Show", "alpha")
        screen.shows(on_screen(gaussians, views.start, splat_size=size, sh_degree=0, mode="alpha"), "alpha")
        screen.tab.close()


def test_two_visitors_look_from_two_places_at_once(browser: Any, gaussians: Gaussians, views: Views, wait: Wait, tmp_path: Path) -> None:
    with served(gaussians, views) as url:
        a, b = (Screen(browser, url, wait, tmp_path) for _ in range(2))
        first, other = on_screen(gaussians, views.start), on_screen(gaussians, views.photos["view_005.png"], mode="normals")
        b.choose("Photo", "view_005.png")
        b.choose("Show", "normals")
        b.shows(other, "the second visitor's view")
        a.shows(first, "the first visitor's view")
        assert np.abs(first[SEEN].astype(float) - other[SEEN]).mean() > 3 * LEVELS
        b.tab.mouse.move(200, 300)
        b.tab.mouse.down()
        b.tab.mouse.move(260, 320, steps=4)
        b.tab.mouse.up()
        b.until(lambda: b.differs(other) > 2 * LEVELS, "a view from elsewhere, after the mouse")
        a.shows(first, "the first visitor's view, as it was")
        b.tab.close()
        size = a.slide("Splat size", 0.2)
        a.shows(on_screen(gaussians, views.start, splat_size=size), "smaller splats, after the other visitor has gone")
        a.tab.close()


def test_a_fit_is_watched_paused_and_left(browser: Any, capture: Capture, wait: Wait, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And ends with the bits of one that nobody watched."""
    monkeypatch.setattr(tsplat.viewer.training, "ABSENCE", math.inf)
    config = FitConfig(steps=40, splats=200, max_splats=300, test_every=4, density="mcmc", background="random", sh_degree=1)
    alone = fit(capture, config, progress=False).gaussians
    steps: list[int] = []
    closed, results = threading.Event(), list[FitResult]()

    def follow(step: Step) -> None:
        """Slow enough for a visitor, who comes, looks and goes before the last steps."""
        steps.append(step.number)
        closed.wait(0.2 if step.number < 30 else 60)

    with training_page(capture, config, port=0) as (page, training):
        screen = Screen(browser, page.url, wait, tmp_path)
        screen.until(lambda: page.visited, "the visitor")
        thread = threading.Thread(target=lambda: results.append(fit(capture, config, progress=False, callbacks=[follow, training])))
        thread.start()
        grey = np.full((HEIGHT, WIDTH, 3), 255.0)
        screen.until(lambda: screen.differs(grey) > 3 * LEVELS and screen.tab.get_by_text(" of 40").count(), "a picture and the step")
        screen.tab.get_by_role("button", name="Pause").click()
        screen.until(lambda: screen.tab.get_by_role("button", name="Go on").count(), "the pause")
        step = steps[-1]
        screen.until(lambda: screen.tab.get_by_text(f"step {step} of 40").count(), "the step at which it holds")
        time.sleep(0.3)
        assert steps[-1] == step < 40
        screen.tab.get_by_role("button", name="Go on").click()
        screen.until(lambda: steps[-1] > step, "the next step")
        screen.tab.close()
        wait(lambda: not page.visited, "the visitor to be gone")
        closed.set()
        thread.join()
    assert steps == list(range(1, 41))
    assert_same_bits([p.detach() for p in results[0].gaussians.parameters()], [p.detach() for p in alone.parameters()])


def test_the_real_program_is_watched_and_ends_by_ctrl_c(browser: Any, capture_folder: Path, wait: Wait, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tsplat", "fit", capture_folder, "-o", tmp_path, "--steps", "100000", "--splats", "200",
               "--view", "--view-port", "0"]
    with subprocess.Popen(command, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}, text=True, stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        url = process.stdout.readline().split()[-1]
        screen = Screen(browser, url, wait, tmp_path)
        screen.until(lambda: screen.tab.get_by_text(" of 100000").count(), "the step")
        screen.until(lambda: screen.tab.get_by_text(f"{WIDTH} x {HEIGHT}, ").count(), "a sharp picture")
        screen.tab.get_by_role("button", name="Pause").click()
        screen.until(lambda: screen.tab.get_by_role("button", name="Go on").count(), "the pause")
        process.send_signal(signal.SIGINT)
        error = process.communicate(timeout=120)[1]
        screen.tab.close()
    assert process.returncode == 130
    assert re.fullmatch(r"tsplat: stopped after step \d+ of 100000; the same call goes on from .*checkpoint.pt\n", error)
