# SPDX-License-Identifier: Apache-2.0
"""Who may visit the page, and what a browser may send to it.

A browser lets every web site open a WebSocket to localhost: without a check, any site that somebody
reads could move the arm. And viser sets whatever attribute of a control a browser names. It offers
no way to check either, but serves its page by the public function `websockets.asyncio.server.serve`
and the public class `ServerConnection`, which `checked_visits` extends while viser starts.
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
    """A connection that leaves out messages which change more of a control than its value."""

    async def recv(self, *arguments: Any, **options: Any) -> Any:
        """Return the next message of the browser that may be handled."""
        while True:
            data = await super().recv(*arguments, **options)
            if _may_be_handled(data):
                return data


def _may_be_handled(data: str | bytes) -> bool:
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
    """Return a page with a title of ours in the browser's tab."""
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
    """Return whether a page of another site opens a connection to a page served at `host`.

    The site of a page is its origin; who sends none is no browser.
    """
    origin = request.headers.get('Origin', '')
    try:
        site = urlsplit(origin)
    except ValueError:
        return True
    # A name of another site that leads to this machine is still another site.
    elsewhere = host in LOCAL and site.hostname not in LOCAL
    return bool(origin) and (site.netloc != request.headers.get('Host') or elsewhere)


@contextmanager
def checked_visits(host: str, title: str) -> Iterator[None]:
    """Check the visits to whatever websockets begins to serve meanwhile at `host`.

    The page has a title in the browser's tab.

    Raises:
        MusculoskeletalError: If it serves nothing meanwhile: then nothing would be checked.
    """
    serve, served = server.serve, False

    def serve_checked(handler: Any, *where: Any, process_request: Any, **options: Any) -> Any:
        nonlocal served
        served = True

        def check(connection: server.ServerConnection, request: Request) -> Response | None:
            if is_foreign(host, request):
                return connection.respond(HTTPStatus.FORBIDDEN, 'a page of another site\n')
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
        problem = 'this version of viser serves its page in a way that cannot be checked'
        raise MusculoskeletalError(f'{problem}; install the one of .ci/requirements-view.txt')
