"""Download files over HTTP, with limits on size and silence. An interrupted download is resumed.

The received part is stored in `NAME.part`. `NAME.part.json` has the total size of the file, and the version mark (ETag
or Last-Modified) that the server sent. The module requests the missing part with Range and If-Range (RFC 9110, sections
13.1.5 and 14.2). If the server's answer does not continue the received part, the download restarts. Proxies come from
the environment (`https_proxy`, `no_proxy`: urllib.request.getproxies).
"""

from __future__ import annotations

import contextlib
import http.client
import json
import re
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any
from urllib.parse import urlsplit

from sitl.vehicle import VehicleError

STALL_S = 20.0
"""A download fails if no data arrive for this number of seconds."""

CHUNK = 1 << 16  # bytes

Progress = Callable[[int, int], None]
"""A function that is called with the number of bytes that were downloaded so far and the total number of bytes."""


class DownloadError(VehicleError):
    """An error: the download of a file failed."""


class NotThereError(DownloadError):
    """An error: the server does not have this file (404 or 410)."""


class UnreachableError(DownloadError):
    """An error: the server cannot be reached."""


@dataclass(frozen=True)
class _PartialDownload:
    """The size of a partly downloaded file and its version mark, as the server reported them."""

    size: int
    validator: str


def download(url: str, target: Path, limit: int, progress: Progress, stall_s: float = STALL_S) -> None:
    """Download `url`, at most `limit` bytes, to `target`. An interrupted download of the same file is resumed.

    `target` is written completely or not at all. Raises DownloadError, or OSError on a disk error.
    """
    part, noted = target.with_name(f"{target.name}.part"), target.with_name(f"{target.name}.part.json")
    kept = _kept(part, noted)
    have, origin = kept or (0, None)
    with _answer(url, {"Range": f"bytes={have}-", "If-Range": origin.validator} if origin else {}, stall_s) as answer:
        if answer.status == http.HTTPStatus.PARTIAL_CONTENT and origin and _fits(answer, have, origin):
            size = origin.size
        elif answer.status == http.HTTPStatus.OK:
            have, size = 0, _size(url, answer, limit)
            part.unlink(missing_ok=True)
            noted.unlink(missing_ok=True)
            if validator := _validator(answer):
                noted.write_text(json.dumps(asdict(_PartialDownload(size, validator))))
        else:
            answer.close()
            if origin is None:
                raise DownloadError(
                    f"the server answered {url} with status {answer.status} instead of a file: try again"
                )
            part.unlink(missing_ok=True)
            download(url, target, limit, progress, stall_s)
            return
        with part.open("ab") as file:
            for chunk in _chunks(url, answer, stall_s):
                file.write(chunk)
                have += len(chunk)
                progress(have, size)
    if have != size:
        raise _broken_off(url)
    part.replace(target)
    noted.unlink(missing_ok=True)


def fetch_text(url: str, limit: int, stall_s: float = STALL_S) -> str:
    """Return the text at `url`, at most `limit` bytes. Raises DownloadError."""
    content = bytearray()
    with _answer(url, {}, stall_s) as answer:
        for chunk in _chunks(url, answer, stall_s):
            content += chunk
            if len(content) > limit:
                raise DownloadError(f"{url} is larger than {megabytes(limit)}, so it is not the expected file")
    return content.decode(errors="replace")


def megabytes(number: int) -> str:
    """Return a size as text, such as `7.0 MB`."""
    return f"{number / 1e6:.1f} MB"


class HttpsRedirectHandler(urllib.request.HTTPRedirectHandler):
    """Follows redirects, but never from https to an unencrypted address."""

    def redirect_request(
        self, req: urllib.request.Request, fp: IO[bytes], code: int, msg: str, headers: Any, newurl: str
    ) -> urllib.request.Request | None:
        if req.type == "https" and urlsplit(newurl).scheme != "https":
            raise DownloadError(f"{req.full_url} leads to {newurl}, which is not encrypted: use another --url")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


@contextlib.contextmanager
def _answer(url: str, headers: Mapping[str, str], stall_s: float) -> Iterator[Any]:
    """Yield the server's answer, which is a success or 416 (Range Not Satisfiable). Raises DownloadError."""
    host = urlsplit(url).netloc
    request = urllib.request.Request(url, headers={"User-Agent": "ucp-harness", **headers})  # noqa: S310 - http(s) only
    opener = urllib.request.build_opener(HttpsRedirectHandler)
    try:
        answer = opener.open(request, timeout=stall_s)
    except urllib.error.HTTPError as error:
        if error.code in (http.HTTPStatus.NOT_FOUND, http.HTTPStatus.GONE):
            raise NotThereError(f"{url} does not exist") from None
        if error.code != http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
            raise DownloadError(f"{host} answers {error.code} ({error.reason}) to {url}: try again later") from None
        answer = error
    except (OSError, http.client.HTTPException) as error:
        reason = getattr(error, "reason", error)
        raise UnreachableError(f"{host} cannot be reached ({getattr(reason, 'strerror', None) or reason})") from None
    with answer:
        yield answer


def _chunks(url: str, answer: Any, stall_s: float) -> Iterator[bytes]:
    """Yield the content in pieces. Raises DownloadError if the content is missing or incomplete."""
    left: int | None = answer.length
    if left is None and not answer.chunked:
        raise _unknown_size_error(url)
    while left != 0:
        try:
            chunk = answer.read1(CHUNK if left is None else min(CHUNK, left))
        except TimeoutError:
            raise DownloadError(
                f"{urlsplit(url).netloc} sent nothing for {stall_s:g} s: run the same command again to continue"
            ) from None
        except (OSError, http.client.HTTPException):
            raise _broken_off(url) from None
        if not chunk and left is None:
            return
        if not chunk:
            raise _broken_off(url)
        left = None if left is None else left - len(chunk)
        yield chunk


def _broken_off(url: str) -> DownloadError:
    return DownloadError(f"{url} ended too early: run the same command again to continue")


def _unknown_size_error(url: str) -> DownloadError:
    """Return the error for an answer that does not state the size of the file. The harness needs the size to check that
    the downloaded file is complete.
    """
    return DownloadError(f"{urlsplit(url).netloc} does not say how large {url} is: use another --url")


def _kept(part: Path, noted: Path) -> tuple[int, _PartialDownload] | None:
    """Return the number of bytes of an earlier partial download, and the size and version mark of the complete file.
    Return None if no earlier part exists.
    """
    try:
        have, origin = part.stat().st_size, _PartialDownload(**json.loads(noted.read_text()))
        return (have, origin) if have else None
    except (OSError, ValueError, TypeError):
        return None


def _fits(answer: Any, have: int, origin: _PartialDownload) -> bool:
    """Return true if a partial answer continues the file after its first `have` bytes."""
    match = re.fullmatch(r"bytes (\d+)-(\d+)/(\d+)", answer.headers.get("Content-Range", ""))
    wanted = (have, origin.size - 1, origin.size)
    return match is not None and tuple(map(int, match.groups())) == wanted and _validator(answer) == origin.validator


def _validator(answer: Any) -> str | None:
    """Return the version mark of the file: a strong ETag, otherwise Last-Modified. Return None if the server sent
    neither.
    """
    etag: str = answer.headers.get("ETag", "")
    return etag if etag.startswith('"') else answer.headers.get("Last-Modified")


def _size(url: str, answer: Any, limit: int) -> int:
    """Return the size that the server announces. Raises DownloadError if the server announces no size, or a size above
    `limit` bytes.
    """
    size: int | None = answer.length
    if size is None:
        raise _unknown_size_error(url)
    if size > limit:
        raise DownloadError(f"{url} has {megabytes(size)}, more than {megabytes(limit)}: use another --url")
    return size
