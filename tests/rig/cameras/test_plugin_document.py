"""The camera of docs/tutorials/camera_driver.md runs, and meets the contract."""

import re
import socketserver
import struct
import threading
import types
from pathlib import Path
from typing import Any

import numpy as np

from faintfield.rig.clock import WallClock
from faintfield.testing import camera_contract

_DOCUMENT = Path(__file__).parents[3] / "docs" / "tutorials" / "camera_driver.md"
_PICTURE = np.arange(12, dtype=np.uint16).reshape(3, 4) * 5000


class Server(socketserver.StreamRequestHandler):
    """The server that the document's camera talks to."""

    def handle(self) -> None:
        for line in self.rfile:
            request, *_ = line.decode().split()
            if request == "REPORT":
                self.wfile.write(b"Sky-1 4 3".ljust(64))
            elif request == "EXPOSE":
                self.wfile.write(struct.pack(">II", 4, 3))
            elif request == "FETCH":
                self.wfile.write(_PICTURE.astype(">u2").tobytes())


def test_documented_camera_meets_the_contract() -> None:
    block = re.search(r"^```python\n(.*?)^```$", _DOCUMENT.read_text(), flags=re.DOTALL | re.MULTILINE)
    assert block is not None
    module = types.ModuleType("faintfield_sky")
    exec(compile(block[1], _DOCUMENT, "exec"), module.__dict__)
    plugin = module.PLUGIN
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Server) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        camera: Any = plugin.make(plugin.settings(host="127.0.0.1", port=server.server_address[1]), WallClock())
        camera_contract(camera, 0.01)
        camera.open()
        assert camera.report().name == "Sky-1"
        np.testing.assert_array_equal(camera.expose(0.01, 1).pixels, _PICTURE)
        camera.close()
        server.shutdown()
