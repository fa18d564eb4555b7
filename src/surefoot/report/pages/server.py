"""The page in the browser and its web socket: who drives, who watches, what is refused.

One port serves the page, the messages as JSON and the 3D view, which is passed on from a port of this machine. The
first tab drives; others watch until it leaves. Messages come from browsers and are hostile until checked.
"""

from __future__ import annotations

import asyncio
import contextlib
import http
import json
import queue
import secrets
import threading
import time
from typing import Any

import websockets
from websockets.asyncio.client import connect
from websockets.asyncio.server import ServerConnection, broadcast, serve
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from surefoot.errors import SurefootError
from surefoot.report.pages.html import document
from surefoot.report.pages.view import bare_viewer

LOCAL = ("localhost", "127.0.0.1", "[::1]")
_MOST_BYTES = 2000
_MOST_MESSAGES = 400
"""Messages that a tab may send in a second; one that sends more is closed."""
_MOST_TABS = 16


class PageServer:
    """Serves the page from a thread of its own.

    Args:
        host: address to listen at; none: this machine only, and without a token.
        port: TCP port; 0 for a free one.
        view_port: of the 3D view, on this machine; none: the page has its own.
        page: HTML; the page that drives, if not given.

    Raises:
        SurefootError: a port that can't be listened at.
    """

    def __init__(self, host: str | None, port: int, view_port: int | None, page: str | None = None) -> None:
        self._page = (document("page.html") if page is None else page).encode()
        self._token = "" if host is None else secrets.token_urlsafe(16)
        self._prefix = f"/{self._token}" if self._token else ""
        self._view_port = view_port
        self.inbox: queue.Queue[dict[str, Any]] = queue.Queue(maxsize=1000)
        """What the driver's tab sent; `{"left": true}` where a driver left."""
        self._hello: dict[str, Any] = {}
        self._tabs: list[ServerConnection] = []
        self._stop = asyncio.Event()
        ready: queue.Queue[int | OSError] = queue.Queue()
        where = (host or "127.0.0.1", port)
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve(*where, ready)), daemon=True)
        self._thread.start()
        bound = ready.get()
        if isinstance(bound, OSError):
            raise SurefootError(f"port {port} at {where[0]}: {bound.strerror or bound}; give another with --port")
        self.port = bound
        self.address = f"http://{host or 'localhost'}:{bound}{self._prefix}/"
        """Where a browser finds the page."""

    @property
    def tabs(self) -> int:
        """Number of open tabs."""
        return len(self._tabs)

    def greet(self, **hello: Any) -> None:
        """Tell all tabs, and those that come, what there is to choose."""
        self._hello = hello
        self._later(self._greet_all)

    def tell(self, **news: Any) -> None:
        """Tell all tabs something."""
        text = json.dumps(news)
        self._later(lambda: broadcast(self._tabs, text))

    def stop(self) -> None:
        """Close all tabs' connections and the port."""
        self._later(self._stop.set)
        self._thread.join(timeout=5.0)

    def _later(self, call: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(call)

    async def _serve(self, host: str, port: int, ready: queue.Queue[int | OSError]) -> None:
        self._loop = asyncio.get_running_loop()
        try:
            async with serve(
                self._handle,
                host,
                port,
                process_request=self._request,
                select_subprotocol=lambda _, offered: next((one for one in offered if one.startswith("viser-v")), None),
                compression=None,
                max_size=_MOST_BYTES,
                max_queue=16,
                close_timeout=0.5,
                logger=_quiet(),
            ) as server:
                ready.put(next(iter(server.sockets)).getsockname()[1])
                await self._stop.wait()
        except OSError as error:
            ready.put(error)

    def _request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Refuse foreign hosts, origins and paths; answer with a page, or go on to a web socket (None)."""
        host, path = request.headers.get("Host", ""), request.path.partition("?")[0]
        # With a name of another site that leads here, that site's script would be of this origin.
        if not self._token and host.rpartition(":")[0] not in LOCAL:
            return connection.respond(http.HTTPStatus.FORBIDDEN, "only localhost\n")
        inside = path.startswith(f"{self._prefix}/")
        name = path[len(self._prefix) + 1 :] if inside else None
        if self._view_port is not None and name in ("socket", "viser"):
            if request.headers.get("Origin") != f"http://{host}":
                return connection.respond(http.HTTPStatus.FORBIDDEN, "foreign origin\n")
            return None
        if name not in ("", "view"):
            return connection.respond(http.HTTPStatus.NOT_FOUND, "not here\n")
        body = self._page if name == "" else bare_viewer().encode()
        kind = [("Content-Type", "text/html; charset=utf-8"), ("Content-Length", str(len(body)))]
        safe = [("X-Frame-Options", "SAMEORIGIN"), ("Referrer-Policy", "no-referrer"), ("Connection", "close")]
        return Response(200, "OK", Headers([*kind, *safe]), body)

    async def _handle(self, connection: ServerConnection) -> None:
        assert connection.request is not None
        if connection.request.path.partition("?")[0].endswith("/viser"):
            await self._pass_on(connection)
        else:
            await self._tab(connection)

    async def _pass_on(self, connection: ServerConnection) -> None:
        """Pass the view on to a browser; what the browser says to it is dropped."""
        protocols = [connection.subprotocol] if connection.subprotocol else None
        with contextlib.suppress(websockets.ConnectionClosed, OSError):
            url = f"ws://127.0.0.1:{self._view_port}"
            async with connect(url, subprotocols=protocols, max_size=None, compression=None) as view:

                async def send() -> None:
                    async for message in view:
                        await connection.send(message)

                sending = asyncio.create_task(send())
                try:
                    async for _ in connection:
                        pass
                finally:
                    sending.cancel()

    async def _tab(self, connection: ServerConnection) -> None:
        if len(self._tabs) >= _MOST_TABS:
            await connection.close(1013, "too many tabs")
            return
        self._tabs.append(connection)
        self._greet_all()
        begin, count = time.monotonic(), 0
        try:
            async for message in connection:
                if time.monotonic() - begin > 1.0:
                    begin, count = time.monotonic(), 0
                count += 1
                if count > _MOST_MESSAGES:
                    await connection.close(1008, "too many messages")
                    return
                self._take(connection, message)
        except websockets.ConnectionClosed:
            pass
        finally:
            drove = self._tabs[0] is connection
            self._tabs.remove(connection)
            if drove:
                self._put({"left": True})
                self._greet_all()

    def _take(self, connection: ServerConnection, message: str | bytes) -> None:
        try:
            given = json.loads(message, parse_constant=_refuse)
        except (ValueError, RecursionError) as error:
            self._answer(connection, f"message refused: {error}"[:200])
            return
        if self._tabs[0] is not connection:
            self._answer(connection, "you watch; another browser drives")
        elif isinstance(given, dict):
            self._put(given)

    @staticmethod
    def _answer(connection: ServerConnection, error: str) -> None:
        # Not waited for: a tab that does not read would hold up the count of its messages.
        broadcast([connection], json.dumps({"error": error}))

    def _put(self, given: dict[str, Any]) -> None:
        with contextlib.suppress(queue.Full):
            self.inbox.put_nowait(given)

    def _greet_all(self) -> None:
        for place, tab in enumerate(self._tabs):
            broadcast([tab], json.dumps({**self._hello, "driver": place == 0, "tabs": len(self._tabs)}))


def _refuse(word: str) -> float:
    raise ValueError(f"{word} is not a number")


def _quiet() -> Any:
    """Return a logger that keeps what browsers do wrong off the terminal."""
    import logging

    logger = logging.getLogger("surefoot.page")
    logger.setLevel(logging.CRITICAL)
    return logger
