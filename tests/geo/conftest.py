"""Storage that tests of this folder share."""

import threading
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest


@dataclass
class WebStorage:
    """A web server on the loopback that keeps what is PUT; ``asked``: methods and paths in their order."""

    url: str = ""
    files: dict = field(default_factory=dict)
    asked: list = field(default_factory=list)


@pytest.fixture
def web_storage():
    """Object storage over plain HTTP: GET, HEAD and PUT."""
    storage = WebStorage()

    class Handler(BaseHTTPRequestHandler):
        def answer(self, body, content=b""):
            storage.asked.append((self.command, self.path))
            self.send_response(200 if body is not None else 404)
            self.send_header("Content-Length", str(len(body or b"")))
            self.end_headers()
            self.wfile.write(content)

        def do_GET(self):
            self.answer(storage.files.get(self.path), storage.files.get(self.path, b""))

        def do_HEAD(self):
            self.answer(storage.files.get(self.path))

        def do_PUT(self):
            storage.files[self.path] = self.rfile.read(int(self.headers["Content-Length"]))
            self.answer(b"")

        def log_message(self, *args):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    storage.url = f"http://127.0.0.1:{server.server_port}"
    yield storage
    server.shutdown()
    server.server_close()
    thread.join()
