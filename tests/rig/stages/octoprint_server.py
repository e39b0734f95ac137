"""Serves OctoPrint's virtual printer on a TCP port; runs as a process of its own, in a Python with OctoPrint.

    python octoprint_server.py '{"resend_ratio": 0}'

The first line on standard output is the port's number. Every connection gets a printer that has just started. Lines on
standard input, such as `!!DEBUG:` commands, go to the printer as if they had come over the connection; each is answered
by a line on standard output.
"""

import importlib
import json
import socket
import sys
import tempfile
import threading
from typing import Any

PROFILE = {"volume": {"width": 400, "depth": 400, "height": 100, "origin": "lowerleft"}}


class Profiles:
    """The only printer profile."""

    def get_current_or_default(self) -> dict[str, Any]:
        return PROFILE


class PrinterServer:
    """Makes a printer for each connection."""

    def __init__(self, changes: dict[str, Any]) -> None:
        self.folder = tempfile.mkdtemp(prefix="octoprint-")
        settings = importlib.import_module("octoprint.settings").settings(init=True, basedir=self.folder)
        plugins = importlib.import_module("octoprint.plugin")
        plugins.plugin_manager(init=True)
        package = importlib.import_module("octoprint.plugins.virtual_printer")
        defaults = package.VirtualPrinterPlugin().get_settings_defaults()
        changed = {"enabled": True, "m115ReportArea": True, "simulated_errors": [], **changes}
        self.settings = plugins.PluginSettings(settings, "virtual_printer", defaults={**defaults, **changed})
        self.make = importlib.import_module("octoprint.plugins.virtual_printer.virtual").VirtualPrinter
        self.printer: Any = None

    def serve(self, connection: socket.socket) -> None:
        """Serve one connection with a printer of its own."""
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        printer = self.printer = self.make(self.settings, Profiles(), self.folder, read_timeout=0.05)
        threading.Thread(target=self.listen, args=(connection, printer), daemon=True).start()
        try:
            while printer.outgoing is not None:
                if line := printer.readline():
                    connection.sendall(line.rstrip(b"\r\n") + b"\n")
        except Exception as failure:
            sys.stderr.write(f"connection ended: {failure!r}\n")
        printer.close()
        connection.close()

    def listen(self, connection: socket.socket, printer: Any) -> None:
        """Pass the lines of a connection to the printer."""
        try:
            # The printer takes one line per write, as OctoPrint itself sends them.
            for line in connection.makefile("rb"):
                while line:
                    line = line[printer.write(line) :]
        except Exception as failure:
            sys.stderr.write(f"listening ended: {failure!r}\n")
        printer.outgoing = None

    def obey(self) -> None:
        """Pass lines of standard input to the printer, and confirm each."""
        for line in sys.stdin:
            self.printer.write(line.encode("ascii"))
            sys.stdout.write("passed on\n")
            sys.stdout.flush()


def main() -> None:
    """Serve until the parent process ends."""
    server = PrinterServer(json.loads(sys.argv[1]))
    listener = socket.create_server(("127.0.0.1", 0))
    sys.stdout.write(f"{listener.getsockname()[1]}\n")
    sys.stdout.flush()

    def accept() -> None:
        while True:
            connection, _ = listener.accept()
            threading.Thread(target=server.serve, args=(connection,), daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    server.obey()


if __name__ == "__main__":
    main()
