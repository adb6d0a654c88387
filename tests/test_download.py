"""`viinter.download` against a server on this machine that breaks in each way that a transfer can."""

import ast
import http.server
import io
import os
import random
import shutil
import signal
import stat
import subprocess
import sys
import threading
import zipfile
from pathlib import Path

import pytest

from viinter import config, download

REPOSITORY = Path(__file__).parents[1]


class Server(http.server.HTTPServer):
    """Serves `files` (path -> bytes); what it was asked for and what it sent is in `log`."""

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Handler)
        self.files = {}
        self.pages = set()  # paths sent as text/html
        self.log = []  # (path, Range header or None, body bytes sent)
        self.drops = []  # of the next requests: after how many bytes the connection is closed
        self.ranges = True
        self.minds_if_range = True
        self.etag = '"one"'
        self.claim = 0  # bytes that Content-Length promises beyond the body
        self.hook = None  # called after a dropped body, before the connection is closed

    def handle_error(self, request, client_address):
        pass  # a client that has gone

    def url(self, path):
        return f"http://127.0.0.1:{self.server_port}{path}"


class Handler(http.server.BaseHTTPRequestHandler):
    def log_message(self, *args):
        pass

    def do_GET(self):
        server, wanted = self.server, self.headers["Range"]
        body = server.files.get(self.path.split("?")[0] if self.path not in server.files else self.path)
        if body is None:
            server.log.append((self.path, wanted, 0))
            self.send_error(404)
            return
        start, total = 0, len(body)
        if server.ranges and wanted:
            same = self.headers["If-Range"] in (None, server.etag)
            if same or not server.minds_if_range:
                start = int(wanted.removeprefix("bytes=").removesuffix("-"))
        if start >= total > 0:
            server.log.append((self.path, wanted, 0))
            self.send_error(416)
            return
        self.send_response(206 if start else 200)
        if start:
            self.send_header("Content-Range", f"bytes {start}-{total - 1}/{total}")
        if server.etag:
            self.send_header("ETag", server.etag)
        kind = "text/html" if self.path in server.pages else "application/zip"
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(total - start + server.claim))
        self.end_headers()
        end = start + server.drops.pop(0) if server.drops else total
        self.wfile.write(body[start:end])
        server.log.append((self.path, wanted, len(body[start:end])))
        if end < total and server.hook:
            self.wfile.flush()
            server.hook()


@pytest.fixture
def server(monkeypatch):
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr(download, "PAUSE_SECONDS", 0.0)
    with Server() as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def picture(seed, size=20_000):
    """Bytes that do not compress; the downloader looks at names only."""
    return random.Random(seed).randbytes(size)


def zipped(members):
    """A zip file of {name or ZipInfo: bytes}, as bytes."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", zipfile.ZIP_DEFLATED) as pack:
        for name, data in members.items():
            pack.writestr(name, data)
    return stream.getvalue()


STANFORD = {f"rectified/out_{r:02d}_{c:02d}_.png": picture(4 * r + c) for r in range(2) for c in range(3)}
LLFF = {f"nerf_llff_data/{scene}/images/{i}.JPG": picture(i) for scene in ("fern", "horns") for i in range(2)}
LLFF |= {f"nerf_llff_data/{scene}/poses_bounds.npy": b"poses" for scene in ("fern", "horns")}
LLFF |= {"__MACOSX/nerf_llff_data/fern/images/._0.JPG": b"clutter"}


def wanted(folder, *urls, name="knights", archive_root="rectified"):
    """The settings of a download into folder/data/NAME."""
    root = str(folder / "data" / name)
    scene = config.SceneConfig(name=name, root=root, url=list(urls), archive_root=archive_root)
    return config.DownloadConfig(scene=scene, paths=config.Paths(data=str(folder / "data")))


def laid(cfg):
    """{relative path: bytes} of the scene folder."""
    root = Path(cfg.scene.root)
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in root.rglob("*") if p.is_file()}


def images(members):
    return {Path(name).name: data for name, data in members.items()}


def stored(cfg):
    """Names in the downloads folder."""
    return sorted(p.name for p in (Path(cfg.paths.data) / ".downloads").glob("*"))


def fails(cfg, *words):
    """Runs a download that must fail with `words` in its message and leave no scene and no unpacking folder."""
    with pytest.raises(config.UserError) as caught:
        download.download(cfg)
    for word in words:
        assert word in str(caught.value)
    assert not Path(cfg.scene.root).exists()
    assert not list(Path(cfg.scene.root).parent.glob("*.unpacking"))
    return str(caught.value)


def test_same_endings_as_image():
    """Read from the source: importing `image` brings PyTorch."""
    for line in ast.parse((REPOSITORY / "viinter" / "image.py").read_text()).body:
        if isinstance(line, ast.Assign) and line.targets[0].id == "EXTENSIONS":
            assert ast.literal_eval(line.value) == download.EXTENSIONS
            return
    raise AssertionError("image.py has no EXTENSIONS")


@pytest.mark.parametrize("folder", ["rectified/", "", "other/deep/"])
def test_whole(server, tmp_path, capsys, folder):
    members = {folder + name: data for name, data in images(STANFORD).items()}
    server.files["/lego_lf/rectified.zip"] = body = zipped({**members, folder + "notes.txt": b"notes"})
    cfg = wanted(tmp_path, server.url("/lego_lf/rectified.zip"))
    result = download.download(cfg)
    assert laid(cfg) == {**images(STANFORD), "notes.txt": b"notes"}
    assert result.pop("seconds") >= 0
    assert result == {
        "scene": "knights",
        "folder": cfg.scene.root,
        "files": 7,
        "images": 6,
        "bytes": 6 * 20_000 + 5,
        "skipped": False,
        "address": cfg.scene.url[0],
        "received": len(body),
        "archive": None,
    }
    said = capsys.readouterr().out
    assert "6 images" in said
    assert cfg.scene.root in said
    assert stored(cfg) == []
    assert [p.name for p in Path(cfg.paths.data).iterdir()] == ["knights"]


def test_existing_scene_is_left_alone(server, tmp_path, capsys):
    cfg = wanted(tmp_path, server.url("/a.zip"))
    Path(cfg.scene.root, "images").mkdir(parents=True)
    Path(cfg.scene.root, "images", "one.PNG").write_bytes(b"mine")
    result = download.download(cfg)
    assert result["skipped"]
    assert (result["images"], result["files"], result["bytes"]) == (1, 1, 4)
    assert laid(cfg) == {"images/one.PNG": b"mine"}
    assert server.log == []
    assert "left alone" in capsys.readouterr().out


def test_existing_folder_without_images(server, tmp_path):
    cfg = wanted(tmp_path, server.url("/a.zip"))
    Path(cfg.scene.root).mkdir(parents=True)
    Path(cfg.scene.root, "notes.txt").write_text("mine")
    with pytest.raises(download.DownloadError, match="holds no images"):
        download.download(cfg)
    assert laid(cfg) == {"notes.txt": b"mine"}
    assert server.log == []
    Path(cfg.scene.root, "notes.txt").unlink()  # an empty folder is as good as none
    server.files["/a.zip"] = zipped(STANFORD)
    assert download.download(cfg)["images"] == 6
    shutil.rmtree(cfg.scene.root)
    Path(cfg.scene.root).write_text("a file")
    with pytest.raises(download.DownloadError, match="in the way"):
        download.download(cfg)


def test_broken_connection_goes_on_at_once(server, tmp_path):
    server.files["/a.zip"] = body = zipped(STANFORD)
    server.drops = [50_000]
    cfg = wanted(tmp_path, server.url("/a.zip"))
    assert download.download(cfg)["received"] == len(body)
    assert server.log == [("/a.zip", None, 50_000), ("/a.zip", "bytes=50000-", len(body) - 50_000)]
    assert laid(cfg) == images(STANFORD)


def test_interrupted_then_resumed_by_the_next_call(server, tmp_path, monkeypatch):
    server.files["/a.zip"] = body = zipped(STANFORD)
    cfg = wanted(tmp_path, server.url("/a.zip"))
    monkeypatch.setattr(download, "TRIES", 1)
    server.drops = [50_000]
    fails(cfg, f"50000 of {len(body)} bytes", server.url("/a.zip"), "the same command goes on")
    assert [name.partition(".")[2] for name in stored(cfg)] == ["zip.part", "zip.part.json"]
    assert download.download(cfg)["received"] == len(body) - 50_000
    assert server.log[1:] == [("/a.zip", "bytes=50000-", len(body) - 50_000)]
    assert laid(cfg) == images(STANFORD)
    assert stored(cfg) == []


@pytest.mark.parametrize("etag", [None, 'W/"weak"'])
def test_resumed_without_a_strong_etag(server, tmp_path, etag):
    server.files["/a.zip"] = body = zipped(STANFORD)
    server.drops, server.etag = [50_000], etag
    download.download(wanted(tmp_path, server.url("/a.zip")))
    assert [sent for _, _, sent in server.log] == [50_000, len(body) - 50_000]


def test_ctrl_c_then_resumed(server, tmp_path):
    server.files["/a.zip"] = body = zipped(STANFORD)
    cfg = wanted(tmp_path, server.url("/a.zip"))
    gone, main = threading.Event(), threading.main_thread().ident
    part = download._part(download._archive(tmp_path / "data/.downloads", cfg.scene.url[0]))

    def interrupt():
        while not part.is_file() or part.stat().st_size < 40_000:
            gone.wait(0.01)
        signal.pthread_kill(main, signal.SIGINT)
        gone.wait(10)

    server.drops, server.hook = [50_000], interrupt
    message = fails(cfg, "interrupted", "the same command goes on")
    gone.set()
    assert "\n" not in message
    have = part.stat().st_size
    assert 40_000 <= have <= 50_000
    assert download.download(cfg)["received"] == len(body) - have
    assert laid(cfg) == images(STANFORD)


def test_stopped_before_the_renaming(server, tmp_path, monkeypatch):
    server.files["/a.zip"] = zipped(STANFORD)
    cfg = wanted(tmp_path, server.url("/a.zip"))
    with monkeypatch.context() as patch:
        patch.setattr(download, "_complete", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        fails(cfg, "interrupted")
    server.log.clear()
    assert download.download(cfg)["received"] == 0
    assert server.log == []
    assert laid(cfg) == images(STANFORD)


def test_server_without_range(server, tmp_path):
    server.files["/a.zip"] = body = zipped(STANFORD)
    server.ranges, server.drops = False, [50_000]
    cfg = wanted(tmp_path, server.url("/a.zip"))
    assert download.download(cfg)["received"] == 50_000 + len(body)
    assert laid(cfg) == images(STANFORD)


@pytest.mark.parametrize("minds", [True, False])
def test_file_changed_between_two_tries(server, tmp_path, monkeypatch, minds):
    """With and without a server that understands If-Range; the two halves are never spliced."""
    server.files["/a.zip"], server.minds_if_range = zipped({"rectified/old.png": picture(99, 120_000)}), minds
    server.drops = [50_000]
    cfg = wanted(tmp_path, server.url("/a.zip"))
    with monkeypatch.context() as patch:
        patch.setattr(download, "TRIES", 1)
        fails(cfg, "truncated")
    server.files["/a.zip"], server.etag = zipped(STANFORD), '"two"'
    result = download.download(cfg)
    assert laid(cfg) == images(STANFORD)
    assert result["received"] == len(server.files["/a.zip"])
    assert len(server.log) == (2 if minds else 3)  # If-Range saves the answer that cannot be used


def test_file_became_shorter_than_what_arrived(server, tmp_path, monkeypatch):
    server.files["/a.zip"] = zipped({"rectified/old.png": picture(99, 300_000)})
    server.drops, server.etag = [250_000], None
    cfg = wanted(tmp_path, server.url("/a.zip"))
    with monkeypatch.context() as patch:
        patch.setattr(download, "TRIES", 1)
        fails(cfg, "truncated")
    server.files["/a.zip"] = zipped(STANFORD)  # 416, as no validator is known
    download.download(cfg)
    assert laid(cfg) == images(STANFORD)


def test_truncated(server, tmp_path):
    body = server.files["/a.zip"] = zipped(STANFORD)
    server.claim, server.ranges = 1000, False
    fails(wanted(tmp_path, server.url("/a.zip")), f"truncated, {len(body)} of {len(body) + 1000} bytes")
    assert len(server.log) == download.TRIES


@pytest.mark.parametrize("how", ["crc", "deflate", "directory", "no zip"])
def test_corrupt(server, tmp_path, how):
    body = bytearray(zipped(STANFORD))
    if how == "crc":  # of the third member, in the central directory
        name = sorted(STANFORD)[2].encode()
        body[body.rindex(name) - 46 + 16] ^= 1
    elif how == "deflate":
        body[60_000:60_100] = bytes(100)
    elif how == "directory":
        del body[-40:]
    else:
        body = b"not found"
    server.files["/a.zip"] = bytes(body)
    cfg = wanted(tmp_path, server.url("/a.zip"))
    fails(cfg, "corrupt", server.url("/a.zip"))
    assert stored(cfg) == []  # the next call does not meet it again
    server.files["/a.zip"] = zipped(STANFORD)
    assert download.download(cfg)["images"] == 6


def link(name):
    member = zipfile.ZipInfo(name)
    member.external_attr = (stat.S_IFLNK | 0o777) << 16
    return member


@pytest.mark.parametrize(
    "member",
    [
        "../evil.png",
        "rectified/../../evil.png",
        "/tmp/viinter_evil.png",
        "C:\\evil.png",
        "..\\evil.png",
        "link",
    ],
)
def test_escaping_member_is_refused(server, tmp_path, member):
    bad = {link("rectified/link"): b"../../../"} if member == "link" else {member: b"evil"}
    server.files["/a.zip"] = zipped({**STANFORD, **bad})
    cfg = wanted(tmp_path / "inside", server.url("/a.zip"))
    fails(cfg, "refused", repr("rectified/link") if member == "link" else repr(member))
    files = [p for p in tmp_path.rglob("*") if not p.is_dir()]
    assert files == []
    assert not Path("/tmp/viinter_evil.png").exists()


def test_addresses_are_tried_in_order(server, tmp_path):
    server.files |= {
        "/bad.zip": b"rubbish",
        "/good.zip": zipped(STANFORD),
        "/page.zip": b"<title>Gone</title>",
    }
    server.pages.add("/page.zip")
    dead = "http://127.0.0.1:9/rectified.zip"
    urls = [
        dead,
        server.url("/none.zip"),
        server.url("/page.zip"),
        server.url("/bad.zip"),
        "file:///etc/passwd",
    ]
    message = fails(wanted(tmp_path, *urls), *urls)
    lines = message.splitlines()[1:]
    reasons = ["refused", "HTTP 404", 'web page in place of an archive, "Gone"', "corrupt", "expected http"]
    for line, reason in zip(lines, reasons, strict=True):
        assert reason in line
    assert list((tmp_path / "data").iterdir()) == []
    cfg = wanted(tmp_path, *urls, server.url("/good.zip"))
    assert download.download(cfg)["address"] == server.url("/good.zip")
    assert laid(cfg) == images(STANFORD)


def test_broken_transfer_of_an_address_given_up_is_removed(server, tmp_path):
    server.files |= {"/bad.zip": zipped(STANFORD), "/good.zip": zipped(STANFORD)}
    server.drops = [1000] * download.TRIES
    cfg = wanted(tmp_path, server.url("/bad.zip"), server.url("/good.zip"))
    download.download(cfg)
    assert laid(cfg) == images(STANFORD)
    assert stored(cfg) == []


def test_archive_of_several_scenes_is_kept_for_the_next(server, tmp_path, capsys):
    server.files["/nerf_llff_data.zip"] = zipped(LLFF)
    url = server.url("/nerf_llff_data.zip")
    fern = wanted(tmp_path, url, name="fern", archive_root="nerf_llff_data/fern")
    horns = wanted(tmp_path, url, name="horns", archive_root="nerf_llff_data/horns/")
    archive = download.download(fern)["archive"]
    assert sorted(laid(fern)) == ["images/0.JPG", "images/1.JPG", "poses_bounds.npy"]
    assert Path(archive).read_bytes() == server.files["/nerf_llff_data.zip"]
    assert f"kept {archive} (8" in capsys.readouterr().out  # kB
    server.log.clear()
    assert download.download(horns)["received"] == 0
    assert server.log == []
    assert laid(horns) == laid(fern)


def test_kept_archive_that_went_bad_is_fetched_again(server, tmp_path):
    server.files["/all.zip"] = zipped(LLFF)
    cfg = wanted(tmp_path, server.url("/all.zip"), name="fern", archive_root="nerf_llff_data/fern")
    archive = Path(download.download(cfg)["archive"])
    archive.write_bytes(b"rotten")
    shutil.rmtree(cfg.scene.root)
    download.download(cfg)
    assert len(server.log) == 2
    assert archive.read_bytes() == server.files["/all.zip"]


def test_scene_that_is_not_in_the_archive(server, tmp_path):
    server.files["/all.zip"] = zipped(LLFF)
    fails(
        wanted(tmp_path, server.url("/all.zip"), name="room", archive_root="nerf_llff_data/room"),
        "archive_root=nerf_llff_data/room", "nerf_llff_data/fern/images, nerf_llff_data/horns/images",
    )  # fmt: skip


def test_no_address(tmp_path):
    cfg = wanted(tmp_path, name="m1")
    cfg.scene.layout = config.Layout.studio
    for cfg.scene.url in (None, []):
        fails(cfg, "m1", "scene.url", "never published")


def test_google_drive(server, tmp_path, monkeypatch):
    """The address that asks no question, and the question that Google may ask all the same."""
    server.files["/download?id=ID_1&export=download&confirm=t"] = zipped(STANFORD)
    monkeypatch.setattr(download, "DRIVE", server.url("/download?id={id}&export=download&confirm=t"))
    assert download.download(wanted(tmp_path / "direct", "gdrive:ID_1"))["images"] == 6
    page = (
        '<html><title>Google Drive - Virus scan warning</title><form id="download-form" '
        'action="/confirmed" method="get"><input type="submit" value="Download anyway"/>'
        '<input type="hidden" name="id" value="ID_2"><input type="hidden" name="uuid" value="a&amp;b"></form>'
    )
    server.files["/download?id=ID_2&export=download&confirm=t"] = page.encode()
    server.pages.add("/download?id=ID_2&export=download&confirm=t")
    server.files["/confirmed?id=ID_2&uuid=a%26b"] = zipped(STANFORD)
    assert download.download(wanted(tmp_path / "asked", "gdrive:ID_2"))["images"] == 6
    server.pages.add("/confirmed?id=ID_2&uuid=a%26b")
    fails(wanted(tmp_path / "never", "gdrive:ID_2"), "gdrive:ID_2: sent a web page")


class Full:
    """A disk without room: `write` fails as the operating system's does."""

    def __init__(self, file):
        self.file = file

    def __enter__(self):
        self.file.__enter__()
        return self

    def __exit__(self, *error):
        return self.file.__exit__(*error)

    def __getattr__(self, name):
        return getattr(self.file, name)

    def write(self, data):
        raise OSError(28, os.strerror(28))


@pytest.mark.parametrize("where", [".part", ".png"])
def test_disk_full(server, tmp_path, monkeypatch, where):
    server.files["/a.zip"] = zipped(STANFORD)
    cfg, opened = wanted(tmp_path, server.url("/a.zip")), Path.open
    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", lambda p, *a, **k: (Full if p.suffix == where else lambda f: f)(opened(p, *a, **k)))
        fails(cfg, "No space left on device")
    download.download(cfg)
    assert laid(cfg) == images(STANFORD)
    assert len(server.log) == (2 if where == ".part" else 1)


def test_too_little_space_is_seen_before_the_transfer(server, tmp_path, monkeypatch):
    server.files["/a.zip"] = zipped(STANFORD)
    usage = shutil.disk_usage(tmp_path)._replace(free=100_000)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
    cfg = wanted(tmp_path, server.url("/a.zip"))
    fails(cfg, "has 100.0 kB free", "needed")
    assert all((Path(cfg.paths.data) / ".downloads" / name).stat().st_size < 1000 for name in stored(cfg))


@pytest.mark.skipif(download.fcntl is None, reason="file locks of Windows are not used")
def test_two_at_once(server, tmp_path):
    cfg = wanted(tmp_path, server.url("/a.zip"))
    store = Path(cfg.paths.data) / ".downloads"
    store.mkdir(parents=True)
    with download._part(download._archive(store, cfg.scene.url[0])).open("ab") as file:
        download.fcntl.flock(file, download.fcntl.LOCK_EX)
        fails(cfg, "another process")
    assert server.log == []


def command(folder, *words):
    return subprocess.run(
        [sys.executable, "-m", "viinter.download", *words],
        cwd=folder, capture_output=True, text=True, timeout=60,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY), "no_proxy": "127.0.0.1"},
    )  # fmt: skip


def test_command_line(server, tmp_path):
    server.files["/lego_lf/rectified.zip"] = zipped(STANFORD)
    url = f"scene.url=['{server.url('/lego_lf/rectified.zip')}']"
    done = command(tmp_path, "scene=stanford/lego", "paths.data=here", url)
    assert done.returncode == 0, done.stderr
    assert "laid 6 images" in done.stdout
    assert [p.name for p in tmp_path.iterdir()] == ["here"]  # no run folder, no log
    assert len([p for p in (tmp_path / "here").rglob("*") if p.is_file()]) == 6
    failed = command(tmp_path, "scene=llff/fern", "paths.data=here", "scene.url=['http://127.0.0.1:9/a.zip']")
    assert failed.returncode == 1
    assert "Traceback" not in failed.stderr + failed.stdout
    assert "http://127.0.0.1:9/a.zip" in failed.stderr + failed.stdout
