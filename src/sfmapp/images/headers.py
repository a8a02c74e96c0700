"""What an image file says of itself, read without decoding it.

Every format is recognised by its first bytes, whatever the file is called. The readers check what can be checked
cheaply: that the file is all there, that it holds one still picture, that its size in pixels can be believed. They
raise :class:`UnusableImage` with the reason and nothing else, whatever the bytes are.
"""

from __future__ import annotations

import os
import re
import stat
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sfmapp.images.tags import Directory, byte_order, read_directory
from sfmapp.images.tiff import UnreadTiffError, tiff_layout


class UnusableImage(Exception):  # noqa: N818 - a verdict on a file, not an error of the program
    """Why a file cannot be used, as a phrase that follows its name and a colon."""


@dataclass(frozen=True)
class Header:
    """An image file at a glance.

    Attributes:
        format: ``jpeg``, ``png``, ``tiff``, ``bmp``, ``webp`` or ``pnm``.
        width, height: pixels as stored, before any orientation.
        bits: per channel, 1 to 16.
        kind: ``gray``, ``rgb``, ``palette`` or ``cmyk``.
        has_alpha: there is, or may be, an alpha channel.
        num_left_out: bands that are neither colour nor alpha, such as near infrared, and are not read.
        exif: the EXIF block, beginning with its TIFF header; empty if there is none. For TIFF the whole file.
        xmp: the XMP packet of a JPEG or TIFF; empty if there is none.
    """

    format: str
    width: int
    height: int
    bits: int = 8
    kind: str = "rgb"
    has_alpha: bool = False
    exif: bytes = b""
    num_left_out: int = 0
    xmp: bytes = b""


def read_header(data: bytes) -> Header:
    """The header of an image file's bytes.

    Raises:
        UnusableImage: no known format, truncated, animated, of an unsupported kind, or broken.
    """
    if not data:
        raise UnusableImage("empty (0 bytes)")
    try:
        header = _reader_of(data)(data)
    except (struct.error, IndexError, ValueError, OverflowError) as error:
        raise UnusableImage("broken header") from error
    if header.width <= 0 or header.height <= 0:
        raise UnusableImage(f"broken header: it claims {header.width}x{header.height} pixels")
    return header


# Marks that no text and hardly another file begins with.
_MARKS = {
    b"\xff\xd8\xff": "JPEG", b"\x89PNG\r\n\x1a\n": "PNG", b"II*\0": "TIFF", b"MM\0*": "TIFF", b"GIF87a": "GIF",
    b"GIF89a": "GIF",
}  # fmt: skip


def picture_format(path: Path) -> str | None:
    """The format of a file that is a picture by its first bytes, whatever it is called; None for any other file."""
    try:
        if not stat.S_ISREG(os.stat(path).st_mode):  # opening a pipe would wait forever
            return None
        with path.open("rb") as file:
            data = file.read(16)
    except OSError:
        return None
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return "WebP"
    return next((name for mark, name in _MARKS.items() if data.startswith(mark)), None)


def _reader_of(data: bytes) -> Callable[[bytes], Header]:
    if data[:3] == b"\xff\xd8\xff":
        return _read_jpeg
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return _read_png
    if byte_order(data):
        return _read_tiff
    if data[:2] == b"BM":
        return _read_bmp
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
        return _read_webp
    if data[:1] == b"P" and data[1:2] in (b"1", b"2", b"3", b"4", b"5", b"6"):
        return _read_pnm
    raise UnusableImage(_foreign_format(data))


def _foreign_format(data: bytes) -> str:
    if data[:6] in (b"GIF87a", b"GIF89a"):
        return "a GIF, which is not read: convert it to PNG"
    if data[4:8] == b"ftyp":
        return "HEIC, AVIF or a video, which is not read: convert it to JPEG"
    if data[:100].lstrip()[:1] in (b"<", b"{"):
        return "text, not an image (a web page saved under this name?)"
    if not any(data[:4096]):
        return "only zeros: the file was not written or copied to its end"
    return "not an image in a known format"


_XMP = b"http://ns.adobe.com/xap/1.0/\0"
_SOF_BASELINE_TO_PROGRESSIVE = (0xC0, 0xC1, 0xC2)
_SOF_ARITHMETIC = (0xC9, 0xCA)
_SOF_OTHER = (0xC3, 0xC5, 0xC6, 0xC7, 0xCB, 0xCD, 0xCE, 0xCF)


def _read_jpeg(data: bytes) -> Header:
    """Walk the segments up to the first scan (ITU T.81, annex B)."""
    exif, xmp, frame = b"", b"", None
    position = 2
    while True:
        if position + 4 > len(data):
            raise UnusableImage("truncated: it ends before the picture's data begin")
        if data[position] != 0xFF:
            raise UnusableImage("broken header")
        marker = data[position + 1]
        if marker == 0xFF:  # padding
            position += 1
            continue
        length = struct.unpack_from(">H", data, position + 2)[0]
        body = data[position + 4 : position + 2 + length]
        if marker == 0xE1 and body[:6] == b"Exif\0\0" and not exif:
            exif = body[6:]
        elif marker == 0xE1 and body.startswith(_XMP) and not xmp:
            xmp = body[len(_XMP) :]
        elif marker in _SOF_BASELINE_TO_PROGRESSIVE or marker in _SOF_ARITHMETIC:
            frame = struct.unpack_from(">BHHB", body)
        elif marker in _SOF_OTHER:
            raise UnusableImage("a lossless or hierarchical JPEG, which is not read: convert it")
        elif marker == 0xDA:
            break
        elif marker == 0xD9 or length < 2:
            raise UnusableImage("broken header")
        position += 2 + length
    if frame is None:
        raise UnusableImage("broken header")
    # Inside a scan every FF of the data is followed by 00, so FF D9 is the end of the picture. Whatever stands behind
    # it (a second picture, a video, padding) is of no interest. Most files end with it: no need to search those.
    if not data.endswith(b"\xff\xd9") and data.find(b"\xff\xd9", position) < 0:
        raise UnusableImage("truncated: the end of the picture is missing")
    bits, height, width, num_channels = frame
    if bits != 8:
        raise UnusableImage(f"a JPEG of {bits} bits, which is not read: convert it to PNG or TIFF")
    kind = {1: "gray", 3: "rgb", 4: "cmyk"}.get(num_channels)
    if kind is None:
        raise UnusableImage(f"a JPEG of {num_channels} channels, which is not read")
    return Header("jpeg", width, height, 8, kind, exif=exif, xmp=xmp)


def _read_png(data: bytes) -> Header:
    """Walk all chunks, with the checksums of those that matter (PNG, 3rd edition, section 5)."""
    width = height = bits = color = 0
    has_transparency, exif, has_pixels = False, b"", False
    position = 8
    while True:
        if position + 12 > len(data):
            raise UnusableImage("truncated: the end of the picture is missing")
        length, name = struct.unpack_from(">I4s", data, position)
        end = position + 12 + length
        if end > len(data):
            raise UnusableImage("truncated: the end of the picture is missing")
        if name in (b"IHDR", b"PLTE", b"IDAT", b"IEND"):
            checksum = struct.unpack_from(">I", data, end - 4)[0]
            if zlib.crc32(memoryview(data)[position + 4 : end - 4]) != checksum:
                raise UnusableImage("damaged: a checksum does not fit")
        if name == b"IHDR":
            width, height, bits, color = struct.unpack_from(">IIBB", data, position + 8)
        elif name == b"acTL":
            raise UnusableImage("animated (APNG): extract its frames first")
        elif name == b"tRNS":
            has_transparency = True
        elif name == b"eXIf":
            exif = data[position + 8 : end - 4]
        elif name == b"IDAT":
            has_pixels = True
        elif name == b"IEND":
            break
        position = end
    kind = {0: "gray", 2: "rgb", 3: "palette", 4: "gray", 6: "rgb"}.get(color)
    if kind is None or not has_pixels or bits not in (1, 2, 4, 8, 16):
        raise UnusableImage("broken header")
    return Header("png", width, height, bits, kind, color in (4, 6) or has_transparency, exif)


def _read_tiff(data: bytes) -> Header:
    try:
        layout = tiff_layout(data)
    except UnreadTiffError as reason:
        raise UnusableImage(str(reason)) from reason
    _check_tiff_data(data, layout.directory)
    _check_single_page(data, layout.directory)
    has_alpha = layout.alpha is not None
    num_left_out = layout.num_samples - layout.num_colors - has_alpha
    packet = layout.directory.values.get(700, b"")
    if isinstance(packet, tuple) and all(0 <= value < 256 for value in packet):
        packet = bytes(map(int, packet))
    return Header(
        "tiff", layout.width, layout.height, layout.bits, layout.kind, has_alpha, data, num_left_out,
        packet if isinstance(packet, bytes) else b"",
    )  # fmt: skip


def _check_tiff_data(data: bytes, first: Directory) -> None:
    """The strips or tiles must lie inside the file."""
    offsets = first.numbers(273) or first.numbers(324)
    sizes = first.numbers(279) or first.numbers(325)
    if not offsets:
        raise UnusableImage("truncated or a broken header")
    if any(o >= len(data) for o in offsets):
        raise UnusableImage("truncated: part of the picture lies beyond the end of the file")
    if any(o + s > len(data) for o, s in zip(offsets, sizes, strict=False)):
        raise UnusableImage("truncated: part of the picture lies beyond the end of the file")


def _check_single_page(data: bytes, first: Directory) -> None:
    """A second full picture makes a document or a stack; thumbnails and masks of the first do not."""
    order, offset, seen = byte_order(data) or "<", first.next_offset, set[int]()
    while offset and offset not in seen and len(seen) < 1000:
        seen.add(offset)
        page = read_directory(data, offset, order)
        is_reduced = int(page.number(254) or 0) & 0b101
        is_old_thumbnail = page.number(255) == 2.0
        if page.values and not is_reduced and not is_old_thumbnail:
            raise UnusableImage("several pages (multi-page TIFF): save each picture as a file of its own")
        offset = page.next_offset


def _read_bmp(data: bytes) -> Header:
    pixel_offset, header_size = struct.unpack_from("<II", data, 10)
    compression = 0
    if header_size == 12:
        width, height, _, bits = struct.unpack_from("<HHHH", data, 18)
    else:
        width, height, _, bits, compression = struct.unpack_from("<iiHHI", data, 18)
    height = abs(height)
    if bits not in (1, 4, 8, 16, 24, 32):
        raise UnusableImage("broken header")
    row = (width * bits + 31) // 32 * 4
    if compression in (0, 3) and pixel_offset + row * height > len(data):
        raise UnusableImage("truncated: the end of the picture is missing")
    return Header("bmp", width, height, 8, "palette" if bits <= 8 else "rgb")


def _read_webp(data: bytes) -> Header:
    """RIFF container of WebP (RFC 9649, section 2)."""
    if struct.unpack_from("<I", data, 4)[0] + 8 > len(data):
        raise UnusableImage("truncated: the end of the picture is missing")
    name = data[12:16]
    if name == b"VP8 ":
        width, height = (value & 0x3FFF for value in struct.unpack_from("<HH", data, 26))
        return Header("webp", width, height)
    if name == b"VP8L":
        word = struct.unpack_from("<I", data, 21)[0]
        return Header("webp", (word & 0x3FFF) + 1, (word >> 14 & 0x3FFF) + 1, has_alpha=bool(word >> 28 & 1))
    if name != b"VP8X":
        raise UnusableImage("broken header")
    flags = data[20]
    if flags & 0x02:
        raise UnusableImage("animated (WebP): extract its frames first")
    width = int.from_bytes(data[24:27], "little") + 1
    height = int.from_bytes(data[27:30], "little") + 1
    return Header("webp", width, height, has_alpha=bool(flags & 0x10), exif=_webp_exif(data))


def _webp_exif(data: bytes) -> bytes:
    position = 12
    while position + 8 <= len(data):
        name, size = struct.unpack_from("<4sI", data, position)
        if name == b"EXIF":
            return data[position + 8 : position + 8 + size].removeprefix(b"Exif\0\0")
        position += 8 + size + (size & 1)
    return b""


_PNM_HEADER = re.compile(rb"P([1-6])" + rb"(?:\s+(?:#[^\n]*\n\s*)*)(\d{1,9})" * 2)
_PNM_MAXIMUM = re.compile(rb"(?:\s+(?:#[^\n]*\n\s*)*)(\d{1,5})")


def _read_pnm(data: bytes) -> Header:
    match = _PNM_HEADER.match(data[:4096])
    if match is None:
        raise UnusableImage("not an image in a known format")
    variant, width, height = (int(group) for group in match.groups())
    maximum, end = 1, match.end()
    if variant not in (1, 4):
        found = _PNM_MAXIMUM.match(data[:4096], end)
        if found is None:
            raise UnusableImage("broken header")
        maximum, end = int(found[1]), found.end()
    if not 0 < maximum < 65536:
        raise UnusableImage("broken header")
    num_channels = 3 if variant in (3, 6) else 1
    # a value of the plain variants (1 to 3) takes at least a digit
    size = 2 if maximum > 255 and variant > 3 else 1
    row = (width + 7) // 8 if variant == 4 else width * num_channels * size
    if end + row * height > len(data):
        raise UnusableImage("truncated: the end of the picture is missing")
    return Header("pnm", width, height, 16 if maximum > 255 else 8, "rgb" if num_channels == 3 else "gray")
