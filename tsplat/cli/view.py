"""`tsplat view`."""

from __future__ import annotations

import argparse
import time

from tsplat_reference.parallel import single_threaded

from tsplat.cli.common import AXES, SCENE, add_device, device_of
from tsplat.scene import Spheres, load_capture, load_scene
from tsplat.viewer import RenderLoop, Settings, Views, draw_view

HELP = "look at a scene in a web page"
USAGE = "tsplat view SCENE [options]"
DESCRIPTION = """
Serve a web page that shows a scene as tsplat renders it, for any number of
visitors, until Ctrl-C. Only this machine can open it, unless --host says more.
It needs pip install 'tsplat[viewer]'.
"""
EXAMPLES = """
  tsplat view scene.ply
  tsplat view out/scene.ply --data capture            its photos' cameras, too
  tsplat view scene.ply --host 0.0.0.0                for all who reach you
  tsplat view scene.ply --device cuda
"""
BACKGROUNDS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
UP = "-y"
PORT = 8080


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("scene", metavar="SCENE", help=SCENE)
    parser.add_argument("--data", metavar="CAPTURE", help="begin at the first camera of this capture (folder or transforms.json), and offer all")
    parser.add_argument("--up", choices=AXES, help=f"which way is up in the scene (default: as in the photos of --data, or --up={UP})")
    parser.add_argument("--background", choices=BACKGROUNDS, default="black", help="to begin with (default: black)")
    parser.add_argument("--antialiased", action="store_true", help="for scenes that were fitted with it")
    parser.add_argument("--host", default="127.0.0.1", metavar="ADDRESS",
                        help="where to listen; 0.0.0.0: anybody who can reach this machine sees the scene (default: 127.0.0.1)")
    parser.add_argument("--port", type=int, default=PORT, help=f"0 for any (default: {PORT})")
    add_device(parser)


def run(options: argparse.Namespace) -> None:
    """Run the command."""
    from tsplat.viewer.page import Page

    settings = Settings(background=BACKGROUNDS[options.background], antialiased=options.antialiased)
    with single_threaded():                                                         # the cores are for the loop's thread
        scene = load_scene(options.scene).to(device_of(options.device))
        if options.data is None:
            views = Views.of_scene(scene, AXES[options.up or UP])
        else:
            views = Views.of_capture(load_capture(options.data, test_every=0), None if options.up is None else AXES[options.up])
        draw_view(scene, views.start.resized(8, 8), settings)                       # what cannot be drawn at all is an error here
    with RenderLoop() as loop, Page(loop, views, settings, None if isinstance(scene, Spheres) else scene.sh_degree,
                                    host=options.host, port=options.port) as page:
        loop.show(scene)
        print(f"{options.scene} is at {page.url} (Ctrl-C to end)", flush=True)
        while True:
            time.sleep(60)
