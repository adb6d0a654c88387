"""`python -m viinter.download scene=stanford/lego`: fetches a published scene and lays it in `scene.root`.

The path of the data: `scene.url` -> `fetch` (DATA/.downloads/NAME.zip.part, then NAME.zip) -> `unpack` (a
hidden folder beside `scene.root`, then `scene.root` itself). Both ends are put in place by one rename, so a
scene folder or an archive that is there under its own name is whole; nothing else marks it.

An archive that holds other scenes as well (LLFF: eight in one) is kept for them; any other is removed once it
is unpacked.

Notation: an address is one entry of `scene.url`: `http://...`, `https://...` or `gdrive:ID` (a file on Google
Drive).
"""

from __future__ import annotations

import contextlib
import hashlib
import html
import http.client
import json
import lzma
import re
import shutil
import stat
import time
import urllib.error
import urllib.parse
import urllib.request
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from typing import IO, Any

from rich.console import Console
from rich.filesize import decimal
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

from viinter import __version__, command
from viinter.config import DownloadConfig, Layout, SceneConfig, UserError

try:
    import fcntl
except ImportError:  # Windows: two downloads of one archive at the same time are not noticed there
    fcntl = None

ABOUT = """
Fetches a published scene from its public address and lays it where training looks for it.

  python -m viinter.download scene=stanford/lego
  python -m viinter.download scene=llff/fern paths.data=/big/disk

A transfer that broke off, or that Ctrl-C ended, goes on when the same command is given again.
A scene that is there already is left alone. The LLFF archive holds eight scenes; it is kept
in DATA/.downloads, so that the next of them needs no transfer.

What matters here: scene, paths.data and, for another mirror, scene.url=[URL], scene.archive_root.
"""

DRIVE = "https://drive.usercontent.google.com/download?id={id}&export=download&confirm=t"
TIMEOUT_SECONDS = 30.0  # without a single byte
TRIES = 3  # of one address, when the connection breaks in the middle
PAUSE_SECONDS = 1.0  # between two tries
BLOCK_BYTES = 1 << 18
# `image.EXTENSIONS`, which would bring seconds of importing PyTorch with it; a test holds the two together.
EXTENSIONS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".exr", ".webp", ".bmp", ".ppm", ".pgm")
BROKEN = (OSError, http.client.HTTPException)  # what reading from a connection raises
UNREADABLE = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, RuntimeError, ValueError, OSError)


class DownloadError(UserError):
    """The scene cannot be fetched or laid; no other address would help."""


class AddressError(DownloadError):
    """One address, or what came from it, is of no use; the next one is tried."""


class BrokenTransfer(AddressError):
    """The connection broke in the middle; the same address is tried again."""


def download(cfg: DownloadConfig) -> dict[str, Any]:
    """Lays the scene `cfg.scene` in `cfg.scene.root`, unless it is there, and says so on the standard output.

    Returns plain data: `scene`; `folder`; `files`, `images` and `bytes` that lie there; `seconds` of this
    call; `skipped`, whether the scene was there already; `address`, where it came from, and `received`, the
    bytes that came over the network in this call (None and 0 if skipped); `archive`, the path of the archive
    if it was kept.

    Raises DownloadError if there is no address, if every address failed (each is listed with its reason:
    cannot be reached, broke off, corrupt, dangerous), if the disk cannot take the scene, if `scene.root` is
    there without images, and on Ctrl-C. What has arrived stays in `cfg.paths.data/.downloads`; the next call
    goes on from it.
    """
    begun = time.monotonic()
    scene, root, store = cfg.scene, Path(cfg.scene.root), Path(cfg.paths.data) / ".downloads"
    result = {"scene": scene.name, "folder": str(root), "skipped": False, "address": None, "received": 0}
    result["archive"] = None
    try:
        if _is_there(root):
            result |= {"skipped": True, "seconds": time.monotonic() - begun, **_contents(root)}
            print(f"{scene.name}: left alone, {root} holds {result['images']} images already; nothing fetched")
            return result
        if not scene.url:
            never = "; the paper's volumetric captures were never published" if scene.layout is Layout.studio else ""
            raise DownloadError(
                f"{scene.name}: scene.url is empty, no public address of this scene is known{never}. Put images into "
                f"{root}, or give scene.url=[URL]"
            )
        result |= _first_that_works(scene, root, store)
        for address in scene.url:  # what broke off at an address that was given up serves nobody now
            _forget(_archive(store, address))
    except KeyboardInterrupt:
        raise DownloadError(
            f"{scene.name}: interrupted. What has arrived stays in {store}; the same command goes on from it"
        ) from None
    except OSError as error:
        raise DownloadError(f"{scene.name}: {_reason(error)}: {error.filename or root}") from error
    finally:
        with contextlib.suppress(OSError):  # of a folder that is not there, or not empty
            store.rmdir()
    result |= {"seconds": time.monotonic() - begun, **_contents(root)}
    print(
        f"{scene.name}: laid {result['images']} images ({result['files']} files, {decimal(result['bytes'])}) "
        f"in {root}, {result['seconds']:.0f} s"
    )
    if result["archive"]:
        size = decimal(Path(result["archive"]).stat().st_size)
        print(f"{scene.name}: kept {result['archive']} ({size}): it holds other scenes, too; delete it at will")
    return result


def _first_that_works(scene: SceneConfig, root: Path, store: Path) -> dict[str, Any]:
    """Goes through the addresses; returns `address`, `received` and `archive` of `download`'s result."""
    failures = []
    store.mkdir(parents=True, exist_ok=True)
    # An archive kept from another scene comes first; if it proves corrupt, its address is asked after it.
    kept = [address for address in scene.url if _archive(store, address).is_file()]
    for address in kept + scene.url:
        archive = _archive(store, address)
        try:
            received = 0 if archive.is_file() else fetch(address, archive, title=scene.name)
            try:
                alone = unpack(archive, root, scene.archive_root, title=scene.name)
            except AddressError:
                archive.unlink()
                raise
        except AddressError as error:
            failures.append(f"{address}: {error}")
            part = _part(archive)
            if part.is_file() and part.stat().st_size == 0:
                _forget(archive)
            continue
        if alone:
            archive.unlink()
        return {"address": address, "received": received, "archive": None if alone else str(archive)}
    left = any(_part(_archive(store, address)).is_file() for address in scene.url)
    raise DownloadError(
        f"{scene.name}: no address gave the scene\n  "
        + "\n  ".join(failures)
        + (f"\nWhat has arrived stays in {store}; the same command goes on from there" if left else "")
    )


def fetch(address: str, archive: Path, title: str) -> int:
    """Transfers `address` into the file `archive`; returns the number of bytes received in this call.

    Bytes go to `archive` + ".part" first, and the server's description of the file (length, ETag,
    Last-Modified) to ".part.json" beside it. If both are there, only the rest is asked for, and only if the
    server still has the same file; otherwise the transfer starts anew. A connection that breaks in the middle
    is tried `TRIES` times.

    Raises AddressError if the address cannot be used, cannot be reached, sends a web page, or breaks off;
    DownloadError if the disk is full or another process is transferring the same archive.
    """
    part, received = _part(archive), 0
    try:
        with part.open("ab") as file, _bar(title) as bar:
            if fcntl is not None:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    raise DownloadError(f"another process is fetching {archive.name}: wait for it") from None
            task = bar.add_task("fetching", total=None)
            for left in reversed(range(TRIES)):
                try:
                    for block in _blocks(address, file, _note(part), bar, task):
                        file.write(block)
                        received += len(block)
                        bar.advance(task, len(block))
                    _complete(file, _note(part))
                    break
                except BrokenTransfer:
                    if not left:
                        raise
                    time.sleep(PAUSE_SECONDS)
        part.rename(archive)
        _note(part).unlink()
    except OSError as error:  # those of the network are AddressErrors by now
        raise DownloadError(
            f"cannot write {part}: {_reason(error)}. What has arrived stays; the same command goes on from it"
        ) from error
    return received


def _blocks(address: str, file: IO[bytes], note: Path, bar: Progress, task: Any) -> Any:
    """Yields what `file` lacks, block by block; empties it first if the server has no continuation of it."""
    have, known = _size(file), _read_note(note)
    if have and have == known.get("total"):
        bar.update(task, completed=have, total=have)
        return  # stopped between the last byte and the renaming
    rest = have > 0 and bool(known)
    headers = {}
    if rest:
        headers["Range"] = f"bytes={have}-"
        strong = known["ETag"] and not known["ETag"].startswith("W/")  # a weak one may not stand in If-Range
        if same := known["ETag"] if strong else known["Last-Modified"]:
            headers["If-Range"] = same
    response = _ask(address, headers)
    rest = rest and response.status == 206 and _continues(response, have, known)
    if headers and not rest and response.status != 200:
        response.close()
        response = _ask(address, {})
    if response.status != (206 if rest else 200):
        response.close()
        raise AddressError(f"HTTP {response.status} where 200 was expected")
    with response:
        if not rest:
            have, length = 0, response.headers.get("Content-Length", "")
            known = {"total": int(length) if length.isdecimal() else None}
            known |= {key: response.headers.get(key) for key in ("ETag", "Last-Modified")}
            file.truncate(0)
            note.write_text(json.dumps(known))
        if known["total"] is not None:
            _want_space(known["total"] - have, note.parent)
        bar.update(task, completed=have, total=known["total"])
        while True:
            try:
                block = response.read1(BLOCK_BYTES)
            except BROKEN as error:
                raise BrokenTransfer(f"broke off after {decimal(_size(file))} ({_reason(error)})") from error
            if not block:
                return
            yield block


def _complete(file: IO[bytes], note: Path) -> None:
    """Raises BrokenTransfer if `file` is not as long as the server said it would be."""
    have, total = _size(file), _read_note(note).get("total")
    if total is not None and have != total:
        raise BrokenTransfer(f"truncated, {have} of {total} bytes arrived")


def _continues(response: Any, have: int, known: dict[str, Any]) -> bool:
    """Whether a 206 answer is the rest, from byte `have`, of the very file that `known` describes.

    A server that overlooks If-Range still sends the ETag, the date or the length of what it has now.
    """
    match = re.fullmatch(r"bytes (\d+)-(\d+)/(\d+|\*)", response.headers.get("Content-Range", "").strip())
    if match is None or int(match[1]) != have:
        return False
    now = {key: response.headers.get(key) for key in ("ETag", "Last-Modified")}
    now["total"] = None if match[3] == "*" else int(match[3])
    return all(now[key] is None or known[key] is None or now[key] == known[key] for key in now)


def _ask(address: str, headers: dict[str, str]) -> Any:
    """The answer, its body unread: a success, or 416, "no such range"; otherwise raises AddressError."""
    if address.startswith("gdrive:"):
        url = DRIVE.format(id=urllib.parse.quote(address.removeprefix("gdrive:"), safe=""))
    else:
        url = address
    headers = {"User-Agent": f"viinter/{__version__}", **headers}
    for last in (False, True):
        if not url.startswith(("http://", "https://")):
            raise AddressError("expected http://..., https://... or gdrive:ID")
        try:
            request = urllib.request.Request(url, headers=headers)
            response = urllib.request.urlopen(request, timeout=TIMEOUT_SECONDS)
        except urllib.error.HTTPError as error:
            if error.code == 416:
                return error  # is a response, too
            error.close()
            raise AddressError(f"HTTP {error.code} {error.reason}") from None
        except (*BROKEN, ValueError) as error:
            raise AddressError(_reason(error)) from error
        if response.headers.get_content_type() != "text/html":
            return response
        with response:
            try:
                page = response.read(1 << 20).decode("utf-8", "replace")
            except BROKEN as error:
                raise AddressError(_reason(error)) from error
        form = _drive_form(page) if address.startswith("gdrive:") else None
        if form is None or last:
            break
        url = urllib.parse.urljoin(url, form)
    title = re.search(r"<title[^>]*>(.*?)</title>", page, re.DOTALL | re.IGNORECASE)
    said = f', "{html.unescape(title[1]).strip()}"' if title else ""
    raise AddressError(f"sent a web page in place of an archive{said}")


def _drive_form(page: str) -> str | None:
    """The address behind "Download anyway" on Google Drive's page for files too large for its virus scan."""
    action = re.search(r'<form[^>]*\baction="([^"]+)"', page)
    fields = {}
    for tag in re.findall(r"<input[^>]*>", page):
        pair = dict(re.findall(r'\b(name|value)="([^"]*)"', tag))
        if "name" in pair:
            fields[html.unescape(pair["name"])] = html.unescape(pair.get("value", ""))
    if action is None or "id" not in fields:
        return None
    return html.unescape(action[1]) + "?" + urllib.parse.urlencode(fields)


def unpack(archive: Path, root: Path, archive_root: str | None, title: str) -> bool:
    """Unpacks the scene in the zip file `archive` to the new folder `root` in one step; checks every CRC.

    The scene is what lies below the folder `archive_root` of the archive. Where that is None or is not in the
    archive, it is the one folder that all images of the archive lie in, or its top.
    Returns True if the archive holds no image besides the scene's.

    Raises AddressError if the archive is no zip file, is corrupt, or has a member that would be written
    outside `root` (`..`, an absolute path, a drive letter, a symbolic link); DownloadError if the scene is
    not in it, or the disk is full. `root` does not exist then.
    """
    fresh = root.with_name(f".{root.name}.unpacking")
    try:
        with contextlib.ExitStack() as stack:
            try:
                pack = stack.enter_context(zipfile.ZipFile(archive))
            except UNREADABLE as error:
                raise AddressError(f"corrupt, not a zip file ({error})") from error
            for member in pack.infolist():
                _refuse_escape(member.filename)
            files = [m for m in pack.infolist() if not m.is_dir() and not _is_clutter(m.filename)]
            prefix = _scene_prefix([m.filename for m in files], archive_root, archive)
            inside = [m for m in files if m.filename.startswith(prefix)]
            for member in inside:
                kind = stat.S_IFMT(member.external_attr >> 16)
                if kind not in (0, stat.S_IFREG):
                    raise AddressError(f"refused, member {member.filename!r} is a link or special file")
            root.parent.mkdir(parents=True, exist_ok=True)
            _want_space(sum(m.file_size for m in inside), root.parent)
            if fresh.exists():  # left behind by a killed process
                shutil.rmtree(fresh)
            stack.callback(shutil.rmtree, fresh, ignore_errors=True)
            bar = stack.enter_context(_bar(title))
            task = bar.add_task("unpacking", total=sum(m.file_size for m in inside))
            for member in inside:
                target = fresh / member.filename[len(prefix) :]
                target.parent.mkdir(parents=True, exist_ok=True)
                with target.open("wb") as file:
                    for block in _member_blocks(pack, member):
                        file.write(block)
                        bar.advance(task, len(block))
            if root.is_dir():
                root.rmdir()  # empty, or `download` would not have come here
            fresh.rename(root)
    except OSError as error:
        raise DownloadError(f"cannot unpack {archive} into {root}: {_reason(error)}") from error
    return sum(_is_image(m.filename) for m in inside) == sum(_is_image(m.filename) for m in files)


def _member_blocks(pack: zipfile.ZipFile, member: zipfile.ZipInfo) -> Any:
    """Yields the bytes of one member; raises AddressError if they cannot be read or their CRC is wrong."""
    try:
        with pack.open(member) as source:
            while block := source.read(BLOCK_BYTES):
                yield block
    except UNREADABLE as error:
        raise AddressError(f"corrupt, member {member.filename!r} cannot be read ({error})") from error


def _refuse_escape(name: str) -> None:
    """Raises AddressError if the member `name` would be written outside the folder it is unpacked to."""
    parts = re.split(r"[/\\]", name)
    if parts[0] == "" or ".." in parts or re.match(r"[A-Za-z]:", name):
        raise AddressError(f"refused, member {name!r} would be written outside the scene's folder")


def _scene_prefix(names: list[str], archive_root: str | None, archive: Path) -> str:
    """What the scene's members begin with, "" or "FOLDER/"; raises DownloadError if the scene is not there."""
    images = [name for name in names if _is_image(name)]
    if archive_root:
        prefix = archive_root.strip("/") + "/"
        if any(name.startswith(prefix) for name in images):
            return prefix
    folders = sorted({str(PurePosixPath(name).parent) for name in images})
    if len(folders) == 1:
        return "" if folders[0] == "." else folders[0] + "/"
    shown = ", ".join(folders[:20]) + (", ..." if len(folders) > 20 else "")
    raise DownloadError(
        f"{archive} has no images in scene.archive_root={archive_root}; "
        + (f"expected one of its folders: {shown}" if folders else "it holds no images at all")
    )


def _is_clutter(name: str) -> bool:
    """Whether a member is what macOS adds to an archive."""
    path = PurePosixPath(name)
    return path.parts[0] == "__MACOSX" or path.name.startswith("._") or path.name == ".DS_Store"


def _is_image(name: str) -> bool:
    return name.lower().endswith(EXTENSIONS)


def _is_there(root: Path) -> bool:
    """Whether `root` holds a scene; raises DownloadError if something else is in its place."""
    if root.exists() and not root.is_dir():
        raise DownloadError(f"{root} is in the way: expected a folder, or nothing")
    if not root.exists() or not any(root.iterdir()):
        return False
    if not _contents(root)["images"]:
        raise DownloadError(f"{root} is there but holds no images ({' '.join(EXTENSIONS)}): remove or empty it")
    return True


def _contents(root: Path) -> dict[str, int]:
    """How many files, images and bytes lie in the folder `root` and below."""
    files = [path for path in root.rglob("*") if path.is_file()]
    return {
        "files": len(files),
        "images": sum(_is_image(path.name) for path in files),
        "bytes": sum(path.stat().st_size for path in files),
    }


def _archive(store: Path, address: str) -> Path:
    """Where the archive of an address lies; scenes that share an address share it."""
    words = re.findall(r"[A-Za-z0-9_]+", urllib.parse.urlsplit(address).path.removesuffix(".zip"))
    digest = hashlib.sha256(address.encode()).hexdigest()[:8]
    return store / ("-".join([*words[-2:], digest])[-100:] + ".zip")


def _part(archive: Path) -> Path:
    return archive.with_name(archive.name + ".part")


def _note(part: Path) -> Path:
    return part.with_name(part.name + ".json")


def _read_note(note: Path) -> dict[str, Any]:
    """What the server said of the file that `.part` is the beginning of; {} if that is not known."""
    try:
        known = json.loads(note.read_text())
        return {key: known[key] for key in ("total", "ETag", "Last-Modified")}
    except (FileNotFoundError, ValueError, KeyError, TypeError):
        return {}


def _forget(archive: Path) -> None:
    """Removes what has arrived of an archive."""
    _part(archive).unlink(missing_ok=True)
    _note(_part(archive)).unlink(missing_ok=True)


def _size(file: IO[bytes]) -> int:
    file.flush()
    return file.seek(0, 2)


def _want_space(size: int, folder: Path) -> None:
    """Raises DownloadError unless `size` bytes are free on the disk of `folder`."""
    free = shutil.disk_usage(folder).free
    if size > free:
        raise DownloadError(f"the disk of {folder} has {decimal(free)} free, {decimal(size)} are needed")


def _bar(title: str) -> Progress:
    return Progress(
        TextColumn(f"{title}: {{task.description}}"),
        BarColumn(),
        DownloadColumn(),
        TransferSpeedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    )


def _reason(error: BaseException) -> str:
    """An error of the operating system or the network in a few words."""
    inner = getattr(error, "reason", None)  # URLError wraps the error that says something
    if isinstance(inner, BaseException):
        return _reason(inner)
    return str(inner or getattr(error, "strerror", None) or error) or type(error).__name__


def main() -> None:
    command.main(DownloadConfig, "download", lambda cfg, _: download(cfg), ABOUT)


if __name__ == "__main__":
    main()
