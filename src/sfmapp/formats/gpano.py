"""What tells viewers that a picture is a panorama: XMP of Google's Photo Sphere (namespace GPano 1.0) in JPEG and PNG.

Only equirectangular pictures have words in it.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

_PACKET = """<?xpacket begin="\N{ZERO WIDTH NO-BREAK SPACE}" id="W5M0MpCehiHzreSzNTczkc9d"?>
<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description rdf:about="" xmlns:GPano="http://ns.google.com/photos/1.0/panorama/"
 GPano:ProjectionType="equirectangular" GPano:UsePanoramaViewer="True"
 GPano:CroppedAreaImageWidthPixels="{width}" GPano:CroppedAreaImageHeightPixels="{height}"
 GPano:FullPanoWidthPixels="{full_width}" GPano:FullPanoHeightPixels="{full_height}"
 GPano:CroppedAreaLeftPixels="{left}" GPano:CroppedAreaTopPixels="{top}"
 GPano:PosePitchDegrees="0" GPano:PoseRollDegrees="0"/>
</rdf:RDF></x:xmpmeta>
<?xpacket end="w"?>"""
_JPEG_NAME = b"http://ns.adobe.com/xap/1.0/\0"
_PNG_HEAD = 8 + 25  # signature and the chunk IHDR


@dataclass(frozen=True)
class Sphere:
    """Where an equirectangular picture lies on the sphere, in pixels: its size, that of the whole sphere, and the place
    of its first pixel in that."""

    width: int
    height: int
    full_width: int
    full_height: int
    left: int
    top: int


def with_gpano(data: bytes, sphere: Sphere) -> bytes:
    """The bytes of a JPEG or PNG file without tags with these; of any other kind as they were."""
    packet = _PACKET.format(**vars(sphere)).encode("utf-8")
    if data[:2] == b"\xff\xd8":
        place = 2
        if data[2:4] == b"\xff\xe0":  # JFIF's own segment comes first
            place += 2 + struct.unpack(">H", data[4:6])[0]
        body = _JPEG_NAME + packet
        return data[:place] + b"\xff\xe1" + struct.pack(">H", len(body) + 2) + body + data[place:]
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        body = b"iTXt" + b"XML:com.adobe.xmp\0\0\0\0\0" + packet
        chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
        return data[:_PNG_HEAD] + chunk + data[_PNG_HEAD:]
    return data
