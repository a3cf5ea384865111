"""`Page`: the viewer's web page, made of viser's parts."""

from __future__ import annotations

import contextlib
import io
import socket
import warnings
from collections.abc import Iterator
from types import TracebackType

import numpy as np

try:
    import viser
except ImportError as error:
    raise ImportError(f"the viewer needs the package viser: pip install 'tsplat[viewer]' ({error})") from None

from tsplat.fit import FitConfig
from tsplat.fit.drawing import fixed_background
from tsplat.scene import Capture
from tsplat.viewer.controls import Controls
from tsplat.viewer.loop import RenderLoop
from tsplat.viewer.training import Report, TrainingView
from tsplat.viewer.view import Settings
from tsplat.viewer.viewpoint import stance
from tsplat.viewer.views import Views

# A visitor who leaves while a picture is on its way is nothing to warn of
warnings.filterwarnings("ignore", r"Queued a \w+ on a closed connection", UserWarning)


class Page:
    """A web server on this machine with a page that any number of visitors can open. Each has a camera and settings of their own.

    Nothing leaves the machine, unless `host` says that other machines may connect. A context manager: the server ends with the block.

    Args:
        loop: which draws; its scene may come later.
        views: where visitors begin, and where they can go.
        settings: what they begin with.
        sh_degree: the highest degree of spherical harmonics that can be chosen; None for spheres.
        host: the address to listen at. The default can only be reached from this machine; `"0.0.0.0"` from all.
        port: 0 for any that is free.

    Raises:
        OSError, ValueError: host and port cannot be used.
    """

    def __init__(self, loop: RenderLoop, views: Views, settings: Settings | None = None, sh_degree: int | None = None, *,
                 host: str = "127.0.0.1", port: int = 8080) -> None:
        self._loop = loop
        self._visitors: dict[int, Controls] = {}
        self._server = server = _start(host, port)
        server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        server.gui.set_panel_label("tsplat")
        start = stance(views.start, views.middle, views.up)
        up = np.array(views.up.tolist())
        server.scene.set_up_direction(up)
        camera = server.initial_camera
        camera.position, camera.look_at, camera.up = (np.array(value) for value in start[:3])
        camera.fov = start.fov

        async def enter(client: viser.ClientHandle) -> None:
            controls = Controls(client, loop, views, settings or Settings(), sh_degree)
            self._visitors[client.client_id] = controls
            await controls.look(client.camera)

        async def leave(client: viser.ClientHandle) -> None:
            self._visitors.pop(client.client_id).close()

        server.on_client_connect(enter)
        server.on_client_disconnect(leave)

    @property
    def visited(self) -> bool:
        """Whether anybody has it open."""
        return self._loop.visitors > 0

    @property
    def url(self) -> str:
        """Of the page, for this machine."""
        host = self._server.get_host()
        return f"http://{'localhost' if host in ('0.0.0.0', '::', '') else f'[{host}]' if ':' in host else host}:{self._server.get_port()}"

    def add_training(self, training: TrainingView) -> None:
        """Also show how a fit is getting on, and a button that pauses it: for all visitors the same."""
        gui = self._server.gui
        with gui.add_folder("Training"):
            text = gui.add_markdown("Waiting for the first step")
            bar = gui.add_progress_bar(0.0)
            button = gui.add_button("Pause")

        async def toggle(_: object) -> None:
            training.toggle()

        def tell(report: Report) -> None:
            text.content = (f"step {report.step} of {report.steps}  \nloss {report.loss:.4f}, PSNR {report.psnr:.2f} dB  \n"
                            f"{report.splats} splats")
            bar.value = 100 * report.step / report.steps      # type: ignore[misc]  # viser: it can be assigned
            button.label = "Go on" if report.paused else "Pause"
            button.disabled = report.step >= report.steps

        button.on_click(toggle)
        training.tell = tell

    def close(self) -> None:
        """End the server."""
        with contextlib.redirect_stdout(io.StringIO()):          # viser says so
            self._server.stop()

    def __enter__(self) -> Page:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()


@contextlib.contextmanager
def training_page(capture: Capture, config: FitConfig, *, host: str = "127.0.0.1", port: int = 8080) -> Iterator[tuple[Page, TrainingView]]:
    """A page on which a fit can be watched, and the callback for that fit.

    Args:
        capture, config: of the fit.
        host, port: see `Page`.
    """
    red, green, blue = fixed_background(config).tolist()
    settings = Settings(background=(red, green, blue), antialiased=config.antialiased)
    degree = None if config.primitive == "spheres" else config.sh_degree
    with RenderLoop(one_core=True) as loop, Page(loop, Views.of_capture(capture), settings, degree, host=host, port=port) as page:
        training = TrainingView(loop, config.steps)
        page.add_training(training)
        yield page, training


class _Server(viser.ViserServer):
    """Without viser's tunnel to a public address, for which any visitor's page could ask."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Does nothing."""


def _start(host: str, port: int) -> viser.ViserServer:
    """A server that listens there and nowhere else."""
    if not 0 <= port < 1 << 16:
        raise ValueError(f"port: expected 0 (any) to 65535; got {port}")
    try:                                                         # viser would take the next free port, or wait for ever if there is none
        socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET).close()
    except OSError as error:
        reason = str(error.strerror).partition(" (")[0]          # not the address once more
        raise OSError(f"host, port: cannot listen at {host}, port {port}: {reason}") from None
    with contextlib.redirect_stdout(io.StringIO()):              # viser prints a table; what we print is `url`
        return _Server(host, port, verbose=False)
