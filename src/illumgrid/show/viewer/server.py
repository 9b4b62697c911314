"""Serve the page to this machine only, to requests that carry its token; for a live page, also new light."""

import secrets
import socket
import sys
import threading
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs

CONNECTIONS = 32
"""Connections at once; more are closed, so that descriptors and threads do not run out."""

CHUNK = 1 << 16
"""Bytes that a slow reader may take `_Answer.timeout` seconds for."""

News = Callable[[dict[str, list[str]]], bytes]
"""Answers requests of a live page, by the names in the address."""

HEADERS = {
    "Content-Type": "text/html; charset=utf-8",
    "Cache-Control": "no-store",
    # In addition to the page's own policy: directives that only a header can give.
    "Content-Security-Policy": "frame-ancestors 'none'; sandbox allow-scripts allow-same-origin allow-downloads",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class PageServer(ThreadingHTTPServer):
    """One page at 127.0.0.1, on a free port, under a new token at each start; below it `news` at "light"."""

    daemon_threads = True

    def __init__(self, page: bytes, news: News | None = None) -> None:
        super().__init__(("127.0.0.1", 0), _Answer)
        self.page, self.news = page, news
        self.place = f"/{secrets.token_urlsafe(24)}/"
        self.free = threading.Semaphore(CONNECTIONS)

    @property
    def address(self) -> str:
        """The address of the page for a browser."""
        return f"http://127.0.0.1:{self.server_address[1]}{self.place}"

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread of its own, unless too many are running."""
        if self.free.acquire(blocking=False):
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self.free.release()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore a browser that closes the connection; report anything else as usual."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


class _Answer(BaseHTTPRequestHandler):
    server: PageServer
    timeout = 20.0
    connection: socket.socket

    def do_GET(self) -> None:
        """Answer with the page if it was requested by its token and by the name of this machine."""
        host = (self.headers.get("Host") or "").rpartition(":")[0]
        if host not in ("127.0.0.1", "localhost"):  # a foreign name that resolves to this machine (DNS rebinding)
            self.send_error(HTTPStatus.FORBIDDEN)
            return
        place, _, asked = self.path.partition("?")
        if secrets.compare_digest(place.encode(), self.server.place.encode()):
            self._send(self.server.page, {})
        elif self.server.news and secrets.compare_digest(place.encode(), f"{self.server.place}light".encode()):
            self._send(self.server.news(parse_qs(asked)), {"Content-Type": "application/octet-stream"})
        else:
            self.send_error(HTTPStatus.NOT_FOUND)

    def _send(self, body: bytes, headers: dict[str, str]) -> None:
        self.send_response(HTTPStatus.OK)
        for name, value in (HEADERS | headers | {"Content-Length": str(len(body))}).items():
            self.send_header(name, value)
        self.end_headers()
        for at in range(0, len(body), CHUNK):
            self.wfile.write(body[at : at + CHUNK])

    def log_message(self, format: str, *args: object) -> None:
        """Write nothing: the terminal belongs to the command."""


def serve(page: bytes, news: News | None = None) -> PageServer:
    """A listening server; ``serve_forever`` answers, leaving the ``with`` block closes it."""
    return PageServer(page, news)
