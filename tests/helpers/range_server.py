"""A local web server with optional faults."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


@dataclass
class Served:
    """Files and behaviour of a server; they may be changed while it runs.

    Attributes:
        files: content by path without the first slash.
        ranges: whether it answers a part where a part is asked for.
        cut_after: bytes after which each answer's connection ends; None: it does not.
        cuts: how many answers are cut.
        status: an error for all requests, 0 for none.
        asked: the Range header of each request, "" where it had none.
    """

    files: dict[str, bytes]
    ranges: bool = True
    cut_after: int | None = None
    cuts: int = 0
    status: int = 0
    requests: list[str] = field(default_factory=list)
    url: str = ""


@contextmanager
def serve(served: Served) -> Iterator[Served]:
    """Run the server while the block runs; ``url`` is set."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            wanted = self.headers.get("Range", "")
            served.requests.append(wanted)
            content = served.files.get(self.path[1:])
            if served.status or content is None:
                self.send_error(served.status or 404)
                return
            tag = f'"{hash(content)}"'
            begin = 0
            if served.ranges and wanted and self.headers.get("If-Range", tag) == tag:
                begin = int(re.findall(r"\d+", wanted)[0])
            if begin >= len(content):  # RFC 9110: the first byte is beyond the last one
                self.send_response(416)
                self.send_header("Content-Range", f"bytes */{len(content)}")
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            self.send_response(206 if begin else 200)
            if begin:
                last = len(content) - 1
                self.send_header("Content-Range", f"bytes {begin}-{last}/{len(content)}")
            self.send_header("Content-Length", str(len(content) - begin))
            self.send_header("ETag", tag)
            self.end_headers()
            end = len(content)
            if served.cuts and served.cut_after is not None:
                served.cuts -= 1
                end = begin + served.cut_after
            with suppress(ConnectionError):  # the other side has enough
                self.wfile.write(content[begin:end])

        def log_message(self, format: str, *arguments: object) -> None:
            """Say nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as http:
        threading.Thread(target=http.serve_forever, args=(0.01,), daemon=True).start()
        served.url = f"http://127.0.0.1:{http.server_port}"
        yield served
        http.shutdown()
