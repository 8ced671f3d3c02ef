"""Storage that tests of this folder share."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

import pytest


@dataclass
class WebStorage:
    """A web server on the loopback that keeps what is PUT; ``asked``: methods and paths in their order."""

    url: str = ""
    files: dict = field(default_factory=dict)
    asked: list = field(default_factory=list)


@contextmanager
def serving(handler: type[BaseHTTPRequestHandler]) -> Iterator[str]:
    """Serve on the loopback; yields the address."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}"
    server.shutdown()
    server.server_close()
    thread.join()


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

    with serving(Handler) as storage.url:
        yield storage


@pytest.fixture
def s3_storage(monkeypatch):
    """A stand-in for S3 on the loopback, named by the environment: objects by path, signed requests alone."""
    storage = WebStorage()
    empty = b"<ListBucketResult><KeyCount>0</KeyCount><IsTruncated>false</IsTruncated></ListBucketResult>"

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def answer(self, content):
            body = b"<Error><Code>NoSuchKey</Code></Error>" if content is None else content
            self.send_response(404 if content is None else 200)
            self.send_header("Content-Length", str(len(body)))
            self.send_header("ETag", '"0"')
            self.send_header("Last-Modified", "Sat, 21 Nov 2026 00:00:00 GMT")
            self.end_headers()
            self.wfile.write(b"" if self.command == "HEAD" else body)

        def path_asked(self):
            assert self.headers["Authorization"].startswith("AWS4-HMAC-SHA256 Credential=me/")
            storage.asked.append((self.command, self.path))
            return unquote(urlsplit(self.path).path)

        def do_GET(self):
            path = self.path_asked()
            self.answer(empty if "list-type" in self.path else storage.files.get(path))

        do_HEAD = do_GET

        def do_PUT(self):
            storage.files[self.path_asked()] = self.rfile.read(int(self.headers["Content-Length"]))
            self.answer(b"")

        def log_message(self, *args):
            pass

    with serving(Handler) as storage.url:
        monkeypatch.setenv("AWS_ENDPOINT_URL", storage.url)
        monkeypatch.setenv("AWS_ACCESS_KEY_ID", "me")
        monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
        monkeypatch.setenv("AWS_DEFAULT_REGION", "eu-west-1")
        yield storage
