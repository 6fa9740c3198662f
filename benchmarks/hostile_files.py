"""Files that are malformed or damaged, or have forged headers; the same in every run."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from turbrestore.core.arrays import FloatArray
from turbrestore.io.video import write_video
from turbrestore.synthesis.scenes import resolution_chart
from turbrestore.synthesis.smooth_flow import distort, smooth_flows

FORMATS = (".mkv", ".mp4", ".avi", ".mov", ".gif", ".png", ".webp", ".ser", ".tif", ".npy")
FLIPPED = {"FFV1 with checksums": ".mkv", "H.264": ".mp4", "SER": ".ser", "TIFF": ".tif", "npy": ".npy"}
# Still images, and whether every flip within the compressed pixels has to be found.
STILLS = {"deflate": True, "LZW": False, "PackBits": False}
CUTS = (0.01, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.75, 0.9, 0.995)
HEIGHT, WIDTH, _COUNT = 48, 64, 12
_HUGE = 60_000


@dataclass(frozen=True)
class Bomb:
    """A file with a forged header, and the command that reads it."""

    write: Callable[[Path], object]
    command: tuple[str, ...] = ("restore", "{input}", "{output}")


def clip(count: int = _COUNT, height: int = HEIGHT, width: int = WIDTH, seed: int = 0) -> FloatArray:
    """Turbulent frames of a chart."""
    rng = np.random.default_rng(seed)
    frames = distort(0.1 + 0.8 * resolution_chart(64, 64), smooth_flows(count, 64, 64, rng), rng, blur=0.8, noise=0.01)
    return np.clip(frames[:, :height, :width], 0, 1).astype(np.float32)


def write_clip(path: Path, kind: str = "") -> None:
    """Write a whole video in the format of the suffix."""
    if path.suffix in (".mkv", ".ser", ".tif", ".npy", ".mp4") and kind != "H.264":
        write_video(path, clip(), 25, 8)
    elif path.suffix in (".gif", ".png", ".webp"):
        import PIL.Image

        images = [PIL.Image.fromarray(np.uint8(255 * frame)) for frame in clip()]
        images[0].save(path, save_all=True, append_images=images[1:], duration=40)
    else:
        codec = {".mp4": ("libx264", "yuv420p"), ".mov": ("mpeg4", "yuv420p"), ".avi": ("mjpeg", "yuvj420p")}
        encode(path, clip(), *codec[path.suffix])


def encode(path: Path, frames: FloatArray, codec: str, pixel_format: str, stamps: list[int] | None = None) -> None:
    """Encode grey frames by PyAV."""
    import av

    with av.open(str(path), "w") as output:
        stream = output.add_stream(codec, rate=25)
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], pixel_format
        for stamp, frame in zip(stamps or range(len(frames)), frames, strict=True):
            picture = av.VideoFrame.from_ndarray(np.uint8(np.rint(255 * frame)), format="gray")
            picture = picture.reformat(format=pixel_format)
            picture.pts = stamp
            output.mux(stream.encode(picture))
        output.mux(stream.encode(None))


def malformed(whole: bytes, suffix: str) -> dict[str, bytes]:
    """Contents that are no video of that format."""
    rng = np.random.default_rng(0)
    magic = b"%PDF-1.7\n%\xe2\xe3\xcf\xd3\n"
    cuts = {f"cut{1000 * share:03.0f}": whole[: int(share * len(whole))] for share in CUTS}
    return {
        "empty": b"",
        "text": b"This is a text and no video.\n" * 50,
        "magic": magic + whole[len(magic) :],
        "random": rng.integers(0, 256, 5000, np.uint8).tobytes(),
        **cuts,
    }


def flipped(path: Path, kind: str, count: int) -> Iterator[bytes]:
    """Copy with one byte changed; of FFV1 within the coded frames, where the checksums are."""
    whole = path.read_bytes()
    rng = np.random.default_rng(1)
    spans = [(0, len(whole))]
    if kind.startswith("FFV1"):
        import av

        with av.open(str(path)) as container:
            packets = [bytes(packet) for packet in container.demux() if packet.size]
        starts = [whole.index(packet) for packet in packets]
        spans = [(start, start + len(packet)) for start, packet in zip(starts, packets, strict=True)]
    for _ in range(count):
        start, stop = spans[rng.integers(len(spans))]
        data = bytearray(whole)
        data[rng.integers(start, stop)] ^= int(rng.integers(1, 256))
        yield bytes(data)


def write_still(path: Path, compression: str) -> tuple[int, int]:
    """Write a compressed TIFF image, and return from where to where its pixels are."""
    import PIL.Image
    import tifffile

    names = {"deflate": "tiff_adobe_deflate", "LZW": "tiff_lzw", "PackBits": "packbits"}
    pixels = np.tile(np.uint8(255 * clip(1)[0]), (2, 2))
    PIL.Image.fromarray(pixels).save(path, compression=names[compression])
    with tifffile.TiffFile(path) as tiff:
        page = tiff.pages.first
        return page.dataoffsets[0], page.dataoffsets[-1] + page.databytecounts[-1]


def flipped_still(path: Path, span: tuple[int, int], count: int) -> Iterator[bytes]:
    """Copy with one byte of the compressed pixels changed."""
    whole, rng = path.read_bytes(), np.random.default_rng(2)
    for _ in range(count):
        data = bytearray(whole)
        data[rng.integers(*span)] ^= int(rng.integers(1, 256))
        yield bytes(data)


def _png(path: Path, side: int, bits: int = 8, colour: int = 0, extra: bytes = b"") -> None:
    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, bits, colour, 0, 0, 0))
    packed = chunk(b"zTXt", b"Comment\0\0" + extra) if extra else b""
    pixels = chunk(b"IDAT", zlib.compress(bytes(2000)))
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + header + packed + pixels + chunk(b"IEND", b""))


def _folder_of_png(path: Path) -> None:
    path.mkdir()
    _png(path / "1.png", _HUGE)


def _jpeg(path: Path) -> None:
    import cv2

    data = bytearray(cv2.imencode(".jpg", np.zeros((16, 16), np.uint8))[1].tobytes())
    place = data.index(b"\xff\xc0") + 5
    data[place : place + 4] = struct.pack(">HH", 65_500, 65_500)
    path.write_bytes(data)


def _tiff(path: Path, tags: dict[int, int]) -> None:
    """Write a small page whose tags are changed."""
    import tifffile

    tifffile.imwrite(path, np.zeros((40, 60, 3), np.uint8), photometric="rgb", metadata=None, rowsperstrip=40)
    data = bytearray(path.read_bytes())
    for tag, value in tags.items():
        place = data.index(struct.pack("<H", tag), 8)
        data[place + 2 : place + 12] = struct.pack("<HII", 4, 1, value)
    path.write_bytes(data)


def _inflating_tiff(path: Path) -> None:
    import tifffile

    packed = zlib.compress(bytes(5 * 10**8), 1)
    tifffile.imwrite(path, iter([packed]), shape=(100, 100), dtype=np.uint8, compression="zlib", metadata=None)


def _short_still(path: Path, compression: str) -> None:
    """Write a few kilobytes of compressed pixels under a header of 8000 by 8000."""
    write_still(path, compression)
    data = bytearray(path.read_bytes())
    for tag in (256, 257, 278):
        place = data.index(struct.pack("<HH", tag, 4), 8) if struct.pack("<HH", tag, 4) in data else 0
        place = place or data.index(struct.pack("<HH", tag, 3), 8)
        data[place + 2 : place + 12] = struct.pack("<HII", 4, 1, 8000)
    path.write_bytes(data)


def _npy_header(shape: tuple[int, ...], descr: str = "<f4") -> bytes:
    text = repr({"descr": descr, "fortran_order": False, "shape": shape}).encode().ljust(117) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def _npz(path: Path, members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> None:
    with zipfile.ZipFile(path, "w", compression) as archive:
        for name, data in members.items():
            archive.writestr(f"{name}.npy", data)


def _nested_npz(path: Path) -> None:
    """Write members that lie within each other: each is stored, and holds the headers of all that follow."""
    core = _npy_header((5 * 10**6,)) + bytes(2 * 10**7)
    body, entries, count = core, [], 60
    names = [b"%d.npy" % number for number in range(count)]
    for name in reversed(names):
        fields = (20, 0, 0, 0, 33, zlib.crc32(body), len(body), len(body), len(name))
        body = struct.pack("<4s5H3I2H", b"PK\3\4", *fields, 0) + name + body
        entries.append((name, fields, len(body)))
    whole = len(body)
    central = b"".join(
        struct.pack("<4s6H3I5H2I", b"PK\1\2", 20, *fields, 0, 0, 0, 0, 0, whole - start) + name
        for name, fields, start in reversed(entries)
    )
    end = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, count, count, len(central), whole, 0)
    path.write_bytes(body + central + end)


def _ser(path: Path, width: int, height: int, frames: int) -> None:
    fields = struct.pack("<7i", 0, 0, 0, width, height, 8, frames)
    path.write_bytes((b"LUCAM-RECORDER" + fields).ljust(178, b"\0") + bytes(5000))


def _avi_header(path: Path) -> None:
    encode(path, clip(), "rawvideo", "bgr24")
    data = bytearray(path.read_bytes())
    place = data.index(b"strf") + 12
    data[place : place + 8] = struct.pack("<ii", 16_000, 16_000)
    path.write_bytes(data)


def _mjpeg_frames(path: Path) -> None:
    encode(path, clip(), "mjpeg", "yuvj420p")
    data = bytearray(path.read_bytes())
    place = data.find(b"\xff\xc0\x00\x11\x08")
    while place >= 0:
        data[place + 5 : place + 9] = struct.pack(">HH", 16_000, 16_000)
        place = data.find(b"\xff\xc0\x00\x11\x08", place + 9)
    path.write_bytes(data)


def _mkv_header(path: Path) -> None:
    write_video(path, np.zeros((2, 320, 320), np.float32), 25, 8)
    data = path.read_bytes()
    for element in (b"\xb0\x82", b"\xba\x82"):  # pixel width and height, of two bytes
        data = data.replace(element + struct.pack(">H", 320), element + b"\xff\xff", 1)
    path.write_bytes(data)


def _gif(path: Path) -> None:
    write_clip(path)
    data = bytearray(path.read_bytes())
    data[6:10] = struct.pack("<HH", 65_535, 65_535)
    path.write_bytes(data)


_EVALUATE = ("evaluate", "{input}", "{truth}")
_DEBLUR = ("deconvolve", "{input}", "{output}")
BOMBS = {
    "huge.png": Bomb(lambda path: _png(path, _HUGE), _EVALUATE),
    "absurd.png": Bomb(lambda path: _png(path, 2**31 - 1), _DEBLUR),
    "short.png": Bomb(lambda path: _png(path, 8000, 16, 6), _EVALUATE),
    "comment.png": Bomb(lambda path: _png(path, 32, extra=zlib.compress(bytes(5 * 10**8), 1)), _DEBLUR),
    "frames of png": Bomb(_folder_of_png),
    "animation.png": Bomb(lambda path: _png(path, _HUGE)),
    "huge.jpg": Bomb(_jpeg, _EVALUATE),
    "huge.tif": Bomb(lambda path: _tiff(path, {256: _HUGE, 257: _HUGE, 278: _HUGE}), _EVALUATE),
    "stack.tif": Bomb(lambda path: _tiff(path, {256: _HUGE, 257: _HUGE, 278: _HUGE})),
    "short.tif": Bomb(lambda path: _tiff(path, {256: 8000, 257: 8000, 278: 8000})),
    "inflating.tif": Bomb(_inflating_tiff),
    **{
        f"short {name}.tif": Bomb(lambda path, name=name: _short_still(path, name), _EVALUATE)
        for name in ("deflate", "LZW", "PackBits")
    },
    "short still.tif": Bomb(lambda path: _tiff(path, {256: 8000, 257: 8000, 278: 8000}), _EVALUATE),
    "many.npy": Bomb(lambda path: path.write_bytes(_npy_header((2**31, 4, 4), "|u1") + bytes(5000))),
    "huge.npy": Bomb(lambda path: path.write_bytes(_npy_header((9, 10**6, 10**6)) + bytes(5000))),
    "overflow.npy": Bomb(lambda path: path.write_bytes(_npy_header((2**32, 2**32, 2**32)) + bytes(5000))),
    "objects.npy": Bomb(lambda path: path.write_bytes(_npy_header((2, 8, 8), "|O") + b"cos\nsystem\n(S'false'\ntR.")),
    "inflating.npz": Bomb(
        lambda path: _npz(path, {"image": _npy_header((10**4, 10**4)) + bytes(4 * 10**8)}, zipfile.ZIP_DEFLATED),
        _DEBLUR,
    ),
    "lying.npz": Bomb(lambda path: _npz(path, {"image": _npy_header((10**6, 10**6)) + bytes(500)}), _DEBLUR),
    "nested.npz": Bomb(_nested_npz, _DEBLUR),
    "objects.npz": Bomb(lambda path: _npz(path, {"header": _npy_header((), "|O") + b"cos\nsystem\n."}), _DEBLUR),
    "huge.ser": Bomb(lambda path: _ser(path, 30_000, 30_000, 5)),
    "many.ser": Bomb(lambda path: _ser(path, 40, 40, 2**31 - 1)),
    "header.avi": Bomb(_avi_header),
    "frames.avi": Bomb(_mjpeg_frames),
    "header.mkv": Bomb(_mkv_header),
    "screen.gif": Bomb(_gif),
}
