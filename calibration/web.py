"""A small HTTP server for one person at one robot: the labelling page and the live preview.

It listens on the loopback interface unless it is told otherwise. What other web pages in the same browser
could do is closed: a Host that is a name (DNS rebinding), a foreign Origin, a POST without the page's token.
"""

from __future__ import annotations

import logging
import secrets
import socket
import threading
from collections.abc import Mapping
from http.server import ThreadingHTTPServer
from types import TracebackType
from typing import Any, Self

from calibration.web_connection import (
    Connection,
    Handler,
    RefusedRequestError,
    Reply,
    Request,
    Site,
    json_reply,
)
from surfclass.errors import InputError

__all__ = ["Handler", "RefusedRequestError", "Reply", "Request", "WebServer", "json_reply"]

TIMEOUT_S = 15.0
"""No read from or write to a connection waits longer."""
BODY_LIMIT = 4 << 20
"""Bytes of a request's body."""
CONNECTIONS = 32
"""At one time; a browser opens six."""
_POLL_S = 0.1

log = logging.getLogger(__name__)


class WebServer:
    """Serves a page and its requests while it is entered.

    In the page, `{{token}}` becomes what a POST must bring in the header `X-Token`, and `{{nonce}}` what
    inline `<script nonce="{{nonce}}">` and `<style nonce="{{nonce}}">` must say to be heeded; nothing is
    loaded from anywhere else. Errors are answered as JSON: `{"error": "what is wrong"}`.

    Args:
        page: The HTML of `/`.
        routes: By method ("GET" or "POST") and path ("/view"): who answers.
        host: The address or name to listen at.
        port: The TCP port; 0 takes any that is free.
        body_limit: Bytes that a POST's body may have.
        timeout_s: No read or write waits longer.

    Raises:
        InputError: If the address cannot be listened at.
    """

    def __init__(
        self,
        page: str,
        routes: Mapping[tuple[str, str], Handler],
        *,
        host: str = "127.0.0.1",
        port: int = 0,
        body_limit: int = BODY_LIMIT,
        timeout_s: float = TIMEOUT_S,
    ) -> None:
        self.token = secrets.token_urlsafe(24)
        self._site = Site(page, dict(routes), self.token, host, body_limit)
        self._server = _listening(self._site, host, port, timeout_s)
        self._thread: threading.Thread | None = None

    @property
    def port(self) -> int:
        """The port it listens at."""
        return int(self._server.server_address[1])

    @property
    def url(self) -> str:
        """What to open in the browser."""
        host = str(self._server.server_address[0])
        return f"http://[{host}]:{self.port}/" if ":" in host else f"http://{host}:{self.port}/"

    def __enter__(self) -> Self:
        self._thread = threading.Thread(
            target=self._server.serve_forever, args=(_POLL_S,), name="web", daemon=True
        )
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Takes no more requests, lets those at work finish, and frees the port; twice is as once."""
        if self._thread is not None:
            self._server.shutdown()
            self._thread.join()
            self._thread = None
        self._server.hang_up()
        self._server.server_close()


class _Server(ThreadingHTTPServer):
    """One thread a connection, so many at most; `server_close` waits for them."""

    daemon_threads = False
    request_queue_size = CONNECTIONS

    def __init__(self, address: tuple[str, int], handler: type[Connection]) -> None:
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        self._lock = threading.Lock()
        self._connections: set[socket.socket] = set()
        super().__init__(address, handler)

    def server_bind(self) -> None:
        """Binds without asking DNS for the machine's name, as HTTPServer would."""
        self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:
        with self._lock:
            full = len(self._connections) >= CONNECTIONS
            if not full:
                self._connections.add(request)
        if full:
            log.warning("%d connections at once: one more is turned away", CONNECTIONS)
            super().shutdown_request(request)
            return
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        with self._lock:
            self._connections.discard(request)
        super().shutdown_request(request)

    def hang_up(self) -> None:
        """Ends the waiting for another request on every connection; answers under way still go out."""
        with self._lock:
            for connection in self._connections:
                try:
                    connection.shutdown(socket.SHUT_RD)
                except OSError:
                    log.debug("a connection was gone already")

    def handle_error(self, request: Any, client_address: Any) -> None:
        log.debug("connection of %s ended early", client_address, exc_info=True)


def _listening(site: Site, host: str, port: int, timeout_s: float) -> _Server:
    handler = type("_OfSite", (Connection,), {"site": site, "timeout": timeout_s})
    try:
        return _Server((host, port), handler)
    except (OSError, OverflowError) as error:
        raise InputError(f"cannot listen at {host}, port {port}: {error}") from None
