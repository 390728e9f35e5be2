"""One HTTP connection of the small server: what it lets in, how it answers, how it refuses."""

from __future__ import annotations

import ipaddress
import json
import logging
import math
import secrets
import socket
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler
from typing import Any
from urllib.parse import parse_qsl

from surfclass.errors import InputError

TOKEN_HEADER = "X-Token"
_FIELDS = 16  # of a query
_DRAIN_S = 0.5
_CHUNK = 1 << 16

log = logging.getLogger(__name__)


class RefusedRequestError(Exception):
    """A request that is answered with an error.

    Attributes:
        status: Of HTTP, 400 and above.
    """

    def __init__(self, status: HTTPStatus, message: str) -> None:
        super().__init__(message)
        self.status = status


@dataclass(frozen=True, slots=True)
class Request:
    """What a handler is called with.

    Attributes:
        query: The fields after the question mark; of a repeated one the last.
        body: Of a POST, else empty.
    """

    query: Mapping[str, str]
    body: bytes

    def json(self) -> Any:
        """Returns the body as JSON.

        Raises:
            InputError: If it is none; numbers must be finite.
        """
        try:
            return json.loads(self.body, parse_constant=_finite, parse_float=_finite)
        except (ValueError, RecursionError) as error:
            raise InputError(f"the body is not JSON: {error}") from None


@dataclass(frozen=True, slots=True)
class Reply:
    """What a handler returns.

    Attributes:
        body: The bytes.
        content_type: Of them.
    """

    body: bytes
    content_type: str


Handler = Callable[[Request], Reply]
"""Answers a request, in a thread of its own; an InputError becomes a 400 with its text."""


def json_reply(value: Any) -> Reply:
    """Returns `value` as JSON; NaN and infinities raise ValueError, as they are none."""
    return Reply(json.dumps(value, allow_nan=False).encode(), "application/json")


@dataclass(frozen=True, slots=True)
class Site:
    """What is served, and to whom."""

    page: str
    routes: Mapping[tuple[str, str], Handler]
    token: str
    host: str
    body_limit: int

    def allows_host(self, header: str) -> bool:
        """Whether a Host names this machine in a way that no foreign DNS can: an address, or `localhost`.

        The port is not compared: behind `ssh -L` it is another.
        """
        name = header.rpartition(":")[0] if ":" in header.rpartition("]")[2] else header
        name = name.lower()
        if name in ("localhost", self.host.lower()):
            return True
        try:
            address = ipaddress.ip_address(name.removeprefix("[").removesuffix("]"))
        except ValueError:
            return False
        return address.is_loopback or not _is_loopback(self.host)

    def methods_of(self, path: str) -> list[str]:
        """The methods that a path answers to."""
        known = [method for method, one in self.routes if one == path]
        return sorted({*known, "GET"}) if path == "/" else sorted(known)


class Connection(BaseHTTPRequestHandler):
    """One connection."""

    protocol_version = "HTTP/1.1"
    server_version, sys_version = "surfclass", ""
    site: Site  # a subclass sets it

    def do_GET(self) -> None:
        """Answers a GET."""
        self._answer("GET")

    def do_POST(self) -> None:
        """Answers a POST."""
        self._answer("POST")

    def _answer(self, method: str) -> None:
        nonce = secrets.token_urlsafe(18)
        try:
            self._check_host()
            path, request = self._request(method)
            handler = self._handler(method, path)
            reply = self._page(nonce) if handler is None else handler(request)
        except RefusedRequestError as error:
            self._refuse(error.status, str(error))
        except InputError as error:
            self._refuse(HTTPStatus.BAD_REQUEST, str(error))
        except TimeoutError:
            self._refuse(HTTPStatus.REQUEST_TIMEOUT, "the body did not come in time")
        except ConnectionError:
            self.close_connection = True
        except Exception:
            log.exception("%s %s failed", method, self.path)
            self._refuse(HTTPStatus.INTERNAL_SERVER_ERROR, "internal error; the terminal says which")
        else:
            self._send(HTTPStatus.OK, reply, "'none'" if handler else f"'nonce-{nonce}'")

    def _page(self, nonce: str) -> Reply:
        text = self.site.page.replace("{{token}}", self.site.token).replace("{{nonce}}", nonce)
        return Reply(text.encode(), "text/html; charset=utf-8")

    def _request(self, method: str) -> tuple[str, Request]:
        """Checks and reads all of it, so that what follows on the connection is the next request."""
        path, _, query = self.path.partition("?")
        if not path.startswith("/"):
            raise RefusedRequestError(HTTPStatus.BAD_REQUEST, "the target must be a path")
        try:
            fields = dict(parse_qsl(query, keep_blank_values=True, max_num_fields=_FIELDS))
        except ValueError:
            raise RefusedRequestError(HTTPStatus.BAD_REQUEST, f"more than {_FIELDS} query fields") from None
        size = self._body_size()
        if method == "GET":
            if size:
                raise RefusedRequestError(HTTPStatus.BAD_REQUEST, "a GET has no body")
            return path, Request(fields, b"")
        self._handler(method, path)  # before the body is read
        self._check_sender()
        if size is None:
            raise RefusedRequestError(HTTPStatus.LENGTH_REQUIRED, "a POST needs a Content-Length")
        body = self.rfile.read(size)
        if len(body) < size:
            raise RefusedRequestError(HTTPStatus.BAD_REQUEST, f"{len(body)} bytes of {size} came")
        return path, Request(fields, body)

    def _handler(self, method: str, path: str) -> Handler | None:
        """Returns who answers; None is the page."""
        handler = self.site.routes.get((method, path))
        if handler is not None or (method, path) == ("GET", "/"):
            return handler
        allowed = self.site.methods_of(path)
        if allowed:
            raise RefusedRequestError(HTTPStatus.METHOD_NOT_ALLOWED, f"allowed: {', '.join(allowed)}")
        raise RefusedRequestError(HTTPStatus.NOT_FOUND, f"there is no {path:.80}")

    def _body_size(self) -> int | None:
        if "Transfer-Encoding" in self.headers:
            raise RefusedRequestError(HTTPStatus.NOT_IMPLEMENTED, "a body needs a Content-Length")
        told = self.headers.get_all("Content-Length", [])
        if not told:
            return None
        if len(told) > 1 or not (told[0].isascii() and told[0].isdigit()):
            raise RefusedRequestError(HTTPStatus.BAD_REQUEST, "Content-Length is not one number")
        limit = self.site.body_limit
        if len(told[0]) > 18 or int(told[0]) > limit:
            message = f"the body has {told[0]:.20} bytes, allowed are {limit}"
            raise RefusedRequestError(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, message)
        return int(told[0])

    def _check_host(self) -> None:
        hosts = self.headers.get_all("Host", [])
        if len(hosts) != 1 or not self.site.allows_host(hosts[0]):
            message = "the Host must be this machine's address, or localhost"
            raise RefusedRequestError(HTTPStatus.FORBIDDEN, message)

    def _check_sender(self) -> None:
        """Raises for a POST that is not our own page's."""
        own = f"http://{self.headers['Host']}"
        if any(origin != own for origin in self.headers.get_all("Origin", [])):
            raise RefusedRequestError(HTTPStatus.FORBIDDEN, "the request comes from another page")
        token = self.headers.get(TOKEN_HEADER, "")
        if not secrets.compare_digest(token.encode("utf-8", "replace"), self.site.token.encode()):
            message = "the token is not this run's: the page is of an earlier one; load it again"
            raise RefusedRequestError(HTTPStatus.FORBIDDEN, message)

    def _refuse(self, status: HTTPStatus, message: str) -> None:
        self.close_connection = True  # of the request there may be more, which is no next one
        self._send(status, json_reply({"error": message}))
        self._drain()

    def _send(self, status: HTTPStatus, reply: Reply, inline: str = "'none'") -> None:
        policy = (
            f"default-src 'none'; script-src {inline}; style-src {inline}; img-src 'self' blob: data:; "
            "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
        )
        self.send_response(status)
        self.send_header("Content-Type", reply.content_type)
        self.send_header("Content-Length", str(len(reply.body)))
        self.send_header("Content-Security-Policy", policy)
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cache-Control", "no-store")
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(reply.body)

    def _drain(self) -> None:
        """Reads a little of what is still coming: closing upon it would reset the answer away."""
        self.connection.shutdown(socket.SHUT_WR)
        self.connection.settimeout(_DRAIN_S)
        try:
            for _ in range(self.site.body_limit // _CHUNK + 1):
                if not self.connection.recv(_CHUNK):
                    return
        except OSError:
            return

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answers what the standard library refuses, as everything else."""
        if not hasattr(self, "headers"):
            self.request_version = self.protocol_version
        self._refuse(HTTPStatus(code), message or HTTPStatus(code).phrase)

    def log_message(self, *words: Any) -> None:
        """Leaves each request to whoever wants details."""
        log.debug("%s: %s", self.address_string(), words[0] % words[1:])


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is no finite number")
    return value
