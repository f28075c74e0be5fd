# SPDX-License-Identifier: Apache-2.0
"""Restricts who may open the page, and what a browser may send to it.

Browsers let every web site open a WebSocket to localhost. Without a check, any site that is open in
a browser could move the arm. Moreover, viser sets any attribute of a control that a browser names.
viser offers no hook for either check. However, it serves its page by the public function
`websockets.asyncio.server.serve` and the public class `ServerConnection`, and `checked_visits`
extends these while viser starts.
"""

import gzip
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

import msgspec
from websockets.asyncio import server
from websockets.datastructures import Headers
from websockets.http11 import Request, Response

from musculoskeletal_ae.exceptions import MusculoskeletalError

LOCAL = ('localhost', '127.0.0.1', '::1')


class Visit(server.ServerConnection):
    """A connection on which a browser can change the value of a control, but nothing else of it."""

    async def recv(self, *arguments: Any, **options: Any) -> Any:
        """Return the next legal message of the browser."""
        while True:
            data = await super().recv(*arguments, **options)
            if _is_legal(data):
                return data


def _is_legal(data: str | bytes) -> bool:
    if isinstance(data, str):  # viser's messages are binary
        return False
    try:
        message = msgspec.msgpack.decode(data, type=dict[str, Any])
    except msgspec.MsgspecError:
        return False
    if message.get('type') != 'GuiUpdateMessage':
        return True
    updates = message.get('updates')
    return isinstance(updates, dict) and updates.keys() <= {'value'}


def with_title(response: Response, title: str) -> Response:
    """Return the response with `title` as the title of the page."""
    is_packed = response.headers.get('Content-Encoding') == 'gzip'
    if not response.headers.get('Content-Type', '').startswith('text/html'):
        return response
    body = gzip.decompress(response.body) if is_packed else bytes(response.body)
    body = body.replace(b'<title>Viser</title>', f'<title>{escape(title)}</title>'.encode(), 1)
    body = gzip.compress(body, compresslevel=1) if is_packed else body
    headers = Headers(response.headers.raw_items())
    if 'Content-Length' in headers:
        del headers['Content-Length']
        headers['Content-Length'] = str(len(body))
    return Response(response.status_code, response.reason_phrase, headers, body)


def is_foreign(host: str, request: Request) -> bool:
    """Return whether a page of another site sent a request to the page served at `host`.

    Browsers send the site in the header `Origin`. Other clients send none and are not foreign.
    """
    origin = request.headers.get('Origin', '')
    try:
        site = urlsplit(origin)
    except ValueError:
        return True
    # A domain name that resolves to this machine is still another site.
    elsewhere = host in LOCAL and site.hostname not in LOCAL
    return bool(origin) and (site.netloc != request.headers.get('Host') or elsewhere)


@contextmanager
def checked_visits(host: str, title: str) -> Iterator[None]:
    """Check all visits to the pages that websockets begins to serve within a `with` block.

    Requests from other sites are refused, and messages that change more than values are dropped.

    Args:
        host: Address of the page.
        title: Title of the page.

    Raises:
        MusculoskeletalError: If websockets did not serve the page, so that nothing checks visits.
    """
    serve, served = server.serve, False

    def serve_checked(handler: Any, *where: Any, process_request: Any, **options: Any) -> Any:
        nonlocal served
        served = True

        def check(connection: server.ServerConnection, request: Request) -> Response | None:
            if is_foreign(host, request):
                return connection.respond(
                    HTTPStatus.FORBIDDEN, 'refused: request from another site\n'
                )
            answer: Response | None = process_request(connection, request)
            return answer if answer is None else with_title(answer, title)

        options |= {'process_request': check, 'create_connection': Visit}
        return serve(handler, *where, **options)

    server.serve = serve_checked  # type: ignore[assignment, misc]
    try:
        yield
    finally:
        server.serve = serve  # type: ignore[misc]
    if not served:
        raise MusculoskeletalError(
            'this version of viser serves its page in a way that this package does not support, so '
            'requests from other web sites could not be refused; install the version of viser that '
            'requirements.txt names'
        )
