"""Server of a page in the browser: the page, its messages and the 3D view, on one port.

Messages are JSON over a web socket. The first tab is in control; other tabs watch until it is closed, and may only stop
the robot. Messages from browsers are untrusted until `messages.read_message` has parsed them; a rejected message is
answered with one line. The 3D view is forwarded from a local port.
"""

from __future__ import annotations

import asyncio
import contextlib
import http
import json
import logging
import queue
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self
from urllib.parse import parse_qsl

import websockets
from websockets.asyncio.client import connect
from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from surefoot.errors import SurefootError
from surefoot.report.pages.html import document
from surefoot.report.pages.messages import DriveMessage, TabMessage, read_message
from surefoot.report.pages.view import RobotView, bare_viewer

LOCAL = ("localhost", "127.0.0.1", "[::1]")
_MAX_MESSAGE_BYTES = 2000
_MAX_MESSAGE_RATE = 400
"""Maximum number of messages per second from a tab or a view, which is closed if it sends more."""
_MAX_ERROR = 300
"""Maximum length of the answer to a rejected message."""
_MAX_TABS = 16
"""Maximum number of open tabs, and of 3D views."""
_REQUEST_TIMEOUT = 600.0
"""Maximum duration of a request with its response, such as the download of a video over a slow network [s]."""
_TYPES = {".html": "text/html; charset=utf-8", ".mp4": "video/mp4"}
"""Content types of downloads, by suffix; other files are `application/octet-stream`."""


def machine_addresses(host: str) -> list[str]:
    """Return the addresses at which other machines reach a server on `host`.

    For 0.0.0.0 and :: these are all of this machine, and loopback only if there is no other. No packet is sent.
    """
    if host not in ("0.0.0.0", "::"):
        return [host]
    # Documentation addresses: the route to them selects the interface.
    family, there, local = (
        (socket.AF_INET6, "2001:db8::1", "::1") if host == "::" else (socket.AF_INET, "192.0.2.1", "127.0.0.1")
    )
    addresses: list[str] = []
    with contextlib.suppress(OSError), socket.socket(family, socket.SOCK_DGRAM) as probe:
        probe.connect((there, 9))
        addresses.append(probe.getsockname()[0])
    with contextlib.suppress(OSError):
        addresses += [str(entry[4][0]) for entry in socket.getaddrinfo(socket.gethostname(), None, family)]
    return [address for address in dict.fromkeys(addresses) if not address.startswith(("127.", "::1"))] or [local]


class _Rate:
    """Counter of a connection's messages per second."""

    def __init__(self) -> None:
        self._begin, self._count = time.monotonic(), 0

    def is_exceeded(self) -> bool:
        """Count a message; return whether the limit is exceeded."""
        if time.monotonic() - self._begin > 1.0:
            self._begin, self._count = time.monotonic(), 0
        self._count += 1
        return self._count > _MAX_MESSAGE_RATE


class PageServer:
    """Server of a page, in its own thread.

    Args:
        host: address to listen at; by default the page is available only on this machine, without a token.
        port: TCP port; 0 selects a free one.
        view_port: local port of the 3D view, or None for a page that contains its scene.
        page: HTML of the page; defaults to the drive page.
        in_notebook: allow pages served by this machine, such as notebooks, to embed the page in a frame.
        messages: dataclass of the messages that tabs may send.

    Raises:
        SurefootError: the port can't be opened.
    """

    def __init__(
        self,
        host: str | None,
        port: int,
        view_port: int | None,
        page: str | None = None,
        in_notebook: bool = False,
        messages: type[TabMessage] = DriveMessage,
    ) -> None:
        if host == "":
            raise SurefootError("--host is empty; give an address of this machine, or leave it out")
        self._page = (page or document("page.html")).encode()
        self._token = "" if host is None else secrets.token_urlsafe(16)
        self._prefix = f"/{self._token}" if self._token else ""
        self._view_port = view_port
        self._frames = "http://localhost:* http://127.0.0.1:*" if in_notebook else ""
        self._messages = messages
        self.inbox: queue.Queue[Any] = queue.Queue(maxsize=1000)
        """Messages (of class `messages`) from the controlling tab, and stop messages from others; None after the
        controlling tab was closed."""
        self.files: dict[str, Path] = {}
        """Files that can be downloaded, by name."""
        self._options: dict[str, Any] = {}
        self._tabs: list[ServerConnection] = []
        self._views = 0
        self._stop = asyncio.Event()
        ready: queue.Queue[int | OSError] = queue.Queue()
        address = host or "127.0.0.1"
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve(address, port, ready)), daemon=True)
        self._thread.start()
        bound = ready.get()
        if isinstance(bound, OSError):
            raise SurefootError(f"port {port} at {address}: {bound.strerror or bound}; give another with --page-port")
        self.port = bound
        names = ["localhost"] if host is None else machine_addresses(host)
        names = [f"[{name}]" if ":" in name else name for name in names]
        self.addresses = [f"http://{name}:{bound}{self._prefix}/" for name in names]
        """URLs of the page; if `host` stands for all addresses of the machine, one URL for each."""
        self.address = self.addresses[0]

    @property
    def tabs(self) -> int:
        """Number of open tabs."""
        return len(self._tabs)

    def print_addresses(self) -> None:
        """Print the URLs of the page."""
        print("\n".join(self.addresses) + "   (Ctrl-C stops)", flush=True)

    def set_options(self, **options: Any) -> None:
        """Send the available options to all present and future tabs."""
        self._options = options
        self._call(self._send_options)

    def update_options(self, **options: Any) -> None:
        """Change some of the options for future tabs only."""
        self._options = {**self._options, **options}

    def send(self, **message: Any) -> None:
        """Send a message to all tabs."""
        text = json.dumps(message)
        self._call(lambda: broadcast(self._tabs, text))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def stop(self) -> None:
        """Close all tabs' connections and the port."""
        self._call(self._stop.set)
        self._thread.join(timeout=5.0)

    def _call(self, function: Callable[[], object]) -> None:
        """Schedule a function in the server's thread."""
        with contextlib.suppress(RuntimeError):  # the event loop has ended
            self._loop.call_soon_threadsafe(function)

    async def _serve(self, host: str, port: int, ready: queue.Queue[int | OSError]) -> None:
        self._loop = asyncio.get_running_loop()
        logger = logging.getLogger("surefoot.page")
        logger.setLevel(logging.CRITICAL)  # errors of browsers do not belong in the terminal
        try:
            async with serve(
                self._handle,
                host,
                port,
                process_request=self._request,
                select_subprotocol=lambda _, offered: next((one for one in offered if one.startswith("viser-v")), None),
                compression=None,
                open_timeout=_REQUEST_TIMEOUT,
                max_size=_MAX_MESSAGE_BYTES,
                max_queue=16,
                close_timeout=0.5,
                logger=logger,
            ) as server:
                ready.put(next(iter(server.sockets)).getsockname()[1])
                await self._stop.wait()
        except OSError as error:
            ready.put(error)

    def _request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Reject foreign hosts, origins and paths; return a page, or None for a web socket."""
        host, (path, _, query) = request.headers.get("Host", ""), request.path.partition("?")
        # DNS rebinding: under another site's name that resolves to this machine, its scripts would have this origin.
        if not self._token and host.rpartition(":")[0] not in LOCAL:
            return connection.respond(http.HTTPStatus.FORBIDDEN, "only localhost\n")
        inside = path.startswith(f"{self._prefix}/")
        name = path[len(self._prefix) + 1 :] if inside else None
        if self._view_port is not None and name in ("socket", "viser"):
            if request.headers.get("Origin") != f"http://{host}":
                return connection.respond(http.HTTPStatus.FORBIDDEN, "foreign origin\n")
            return None
        # The 3D view runs scripts that its server sends, with this origin: its server must be this one.
        own = [("websocket", f"ws://{host}{path.removesuffix('view')}viser")]
        if name == "view" and parse_qsl(query, keep_blank_values=True) != own:
            return connection.respond(http.HTTPStatus.FORBIDDEN, "the view of another server\n")
        try:
            body, kind = self._content(name)
        except (KeyError, OSError):
            return connection.respond(http.HTTPStatus.NOT_FOUND, "not here\n")
        frames = ("Content-Security-Policy", f"frame-ancestors 'self' {self._frames}".rstrip())
        safe = [frames, ("Referrer-Policy", "no-referrer"), ("Connection", "close")]
        return Response(200, "OK", Headers([*kind, ("Content-Length", str(len(body))), *safe]), body)

    def _content(self, name: str | None) -> tuple[bytes, list[tuple[str, str]]]:
        """Return the content at a path below the page, and its headers.

        Raises:
            KeyError: there is no content with that name.
            OSError: a file can't be read.
        """
        page = [("Content-Type", "text/html; charset=utf-8")]
        if name == "":
            return self._page, page
        if name == "view":
            return bare_viewer().encode(), page
        file = self.files[(name or "").removeprefix("files/")]
        kind = _TYPES.get(file.suffix, "application/octet-stream")
        # Files are only downloaded, never opened as a page of this origin, whose scripts could control the robot.
        headers = [
            ("Content-Disposition", f'attachment; filename="{file.name}"'),
            ("X-Content-Type-Options", "nosniff"),
        ]
        return file.read_bytes(), [("Content-Type", kind), *headers, ("Cross-Origin-Resource-Policy", "same-origin")]

    async def _handle(self, connection: ServerConnection) -> None:
        assert connection.request is not None
        if not connection.request.path.partition("?")[0].endswith("/viser"):
            await self._handle_tab(connection)
        elif self._views >= _MAX_TABS:
            await connection.close(1013, "too many views")
        else:
            self._views += 1
            try:
                await self._forward_view(connection)
            finally:
                self._views -= 1

    async def _forward_view(self, connection: ServerConnection) -> None:
        """Forward the 3D view to a browser, and drop the browser's messages to it."""
        protocols = [connection.subprotocol] if connection.subprotocol else None
        with contextlib.suppress(websockets.ConnectionClosed, OSError):
            url = f"ws://127.0.0.1:{self._view_port}"
            async with connect(url, subprotocols=protocols, max_size=None, compression=None) as view:

                async def forward() -> None:
                    async for message in view:
                        await connection.send(message)

                task = asyncio.create_task(forward())
                rate = _Rate()
                try:
                    async for _ in connection:
                        if rate.is_exceeded():
                            await connection.close(1008, "too many messages")
                            return
                finally:
                    task.cancel()

    async def _handle_tab(self, connection: ServerConnection) -> None:
        if len(self._tabs) >= _MAX_TABS:
            await connection.close(1013, "too many tabs")
            return
        self._tabs.append(connection)
        self._send_options()
        rate = _Rate()
        try:
            async for message in connection:
                if rate.is_exceeded():
                    await connection.close(1008, "too many messages")
                    return
                self._receive(connection, message)
        except websockets.ConnectionClosed:
            pass
        finally:
            was_driver = self._tabs[0] is connection
            self._tabs.remove(connection)
            if was_driver:
                self._put(None)
                self._send_options()

    def _receive(self, connection: ServerConnection, text: str | bytes) -> None:
        try:
            message = read_message(self._messages, text)
            if self._tabs[0] is not connection and not message.is_from_anyone:
                raise SurefootError("you are watching; another browser is in control")
            self._put(message)
        except SurefootError as error:
            # Not awaited, because a tab that does not read would block the counting of its messages.
            broadcast([connection], json.dumps({"error": str(error)[:_MAX_ERROR]}))

    def _put(self, message: TabMessage | None) -> None:
        with contextlib.suppress(queue.Full):
            self.inbox.put_nowait(message)

    def _send_options(self) -> None:
        for place, tab in enumerate(self._tabs):
            broadcast([tab], json.dumps({**self._options, "driver": place == 0, "tabs": len(self._tabs)}))


@contextlib.contextmanager
def robot_page(
    host: str | None, port: int, in_notebook: bool = False, messages: type[TabMessage] = DriveMessage
) -> Iterator[tuple[PageServer, RobotView]]:
    """Context manager that serves a page with robots in 3D; yield page and view. For the arguments see `PageServer`."""
    view = RobotView()
    try:
        with PageServer(host, port, view.port, in_notebook=in_notebook, messages=messages) as page:
            yield page, view
    finally:
        view.stop()
