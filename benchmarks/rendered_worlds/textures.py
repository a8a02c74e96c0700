"""Procedural grey textures for rendered worlds: what walls, floors, furniture, facades and cars are made of.

Every function draws from the generator it is given and returns (H, W) uint8 with sides that are powers of two. Those
that cover large surfaces repeat without a seam; the others are meant to be shown once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Rng = np.random.Generator
Grey = NDArray[np.uint8]
Floats = NDArray[np.float32]


def _finish(values: NDArray[np.floating]) -> Grey:
    out: Grey = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return out


def noise(rng: Rng, size: int, cells: int, octaves: int = 4, roughness: float = 0.5) -> Floats:
    """Seamless value noise of standard deviation one, (size, size) float32: octaves from ``cells`` cells a side."""
    import cv2

    total = np.zeros((size, size), np.float32)
    for octave in range(octaves):
        count = min(cells << octave, size)
        grid = np.pad(rng.standard_normal((count, count), np.float32), 2, mode="wrap")
        scale = size // count if size % count == 0 else size / count
        large = cv2.resize(grid, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
        start = round(2 * scale)
        total += np.float32(roughness**octave) * large[start : start + size, start : start + size]
    even: Floats = (total - total.mean()) / total.std()
    return even


def dirt(rng: Rng, size: int = 512) -> Grey:
    """Overlay around 128: stains and weathering that make repeated materials differ from place to place."""
    stains = np.tanh(1.5 * noise(rng, size, 8, 5, 0.6))
    return _finish(128 + 6 * noise(rng, size, 4, 4) + 6 * stains)


def plaster(rng: Rng, size: int = 512) -> Grey:
    """A painted wall: nearly nothing to see."""
    return _finish(190 + 1.5 * noise(rng, size, 4, 3) + 1.5 * noise(rng, size, 128, 2))


def concrete(rng: Rng, size: int = 512) -> Grey:
    """Grey concrete with pores and the joints of its formwork."""
    out = 140 + 6 * noise(rng, size, 8, 6, 0.6)
    for _ in range(250):
        x, y = rng.integers(0, size - 3, 2)
        out[y : y + 2, x : x + rng.integers(1, 4)] -= rng.uniform(20, 60)
    out[::256, :] -= 35
    out[:, ::256] -= 35
    return _finish(out)


def bricks(rng: Rng, size: int = 512, rows: int = 16, columns: int = 4) -> Grey:
    """Brickwork; every brick has a tone of its own."""
    out = 165 + 5 * noise(rng, size, 64, 3)
    high, wide, joint = size // rows, size // columns, max(size // 170, 2)
    for r in range(rows):
        for c in range(columns):
            x0 = c * wide + (wide // 2 if r % 2 else 0)
            xs = np.arange(x0 + joint, x0 + wide) % size
            tone = rng.normal(105, 16)
            out[np.ix_(np.arange(r * high + joint, (r + 1) * high), xs)] = tone
    return _finish(out + 5 * noise(rng, size, 32, 4, 0.7))


def tiles(rng: Rng, size: int = 512, count: int = 8, tone: float = 150, spread: float = 8) -> Grey:
    """Square tiles with dark joints."""
    each = size // count
    out = np.kron(rng.normal(tone, spread, (count, count)), np.ones((each, each))) + 4 * noise(rng, size, 16, 5, 0.7)
    for k in range(count):
        out[k * each : k * each + max(size // 200, 2)] -= 50
        out[:, k * each : k * each + max(size // 200, 2)] -= 50
    return _finish(out)


def planks(rng: Rng, size: int = 512, count: int = 8, tone: float = 120) -> Grey:
    """Wooden boards along x, with grain, joints and knots."""
    import cv2

    grain = cv2.resize(noise(rng, size, 64, 3)[:, : size // 16].copy(), (size, size), interpolation=cv2.INTER_CUBIC)
    out = tone + 7 * grain + 4 * noise(rng, size, 4, 3)
    high = size // count
    for k in range(count):
        rows = slice(k * high, (k + 1) * high)
        out[rows] += rng.normal(0, 10)
        out[k * high : k * high + 2] -= 45
        x = int(rng.integers(0, size - 2))
        out[rows, x : x + 2] -= 45
        cv2.circle(out, (int(rng.integers(20, size - 20)), k * high + high // 2), int(rng.integers(3, 7)), 70.0, -1)
    return _finish(out)


def carpet(rng: Rng, size: int = 512) -> Grey:
    """Short pile in two tones, with a woven pattern."""
    y, x = np.mgrid[:size, :size]
    weave = np.sign(np.sin(x * 2 * np.pi / 64) * np.sin(y * 2 * np.pi / 64))
    return _finish(95 + 9 * noise(rng, size, 64, 4, 0.9) + 6 * weave + 4 * noise(rng, size, 4, 2))


def asphalt(rng: Rng, size: int = 1024) -> Grey:
    """A road: grain, patches that were mended, cracks."""
    import cv2

    out = 88 + 5 * noise(rng, size, 128, 4, 1.0) + 3 * noise(rng, size, 4, 4)
    for _ in range(3):
        x, y, w, h = rng.integers(0, size - 260), rng.integers(0, size - 260), *rng.integers(60, 250, 2)
        out[y : y + h, x : x + w] -= rng.uniform(4, 14)
    for _ in range(9):
        at = rng.integers(100, size - 100, 2).astype(float)
        heading, points = rng.uniform(0, 2 * np.pi), []
        for _ in range(int(rng.integers(10, 40))):
            points.append(at.copy())
            heading += rng.normal(0, 0.5)
            at += 9 * np.array([np.cos(heading), np.sin(heading)])
        cv2.polylines(out, [np.array(points, np.int32)], False, 52.0, int(rng.integers(1, 3)), cv2.LINE_AA)
    return _finish(out)


def grass(rng: Rng, size: int = 512) -> Grey:
    """A lawn."""
    return _finish(100 + 17 * noise(rng, size, 64, 4, 0.9) + 8 * noise(rng, size, 4, 4))


def leaves(rng: Rng, size: int = 512, radius: int = 8) -> Grey:
    """A hedge or the crown of a tree: leaves over leaves, darker below."""
    import cv2

    out = np.full((size, size), 40, np.float32)
    count = 3 * size * size // (radius * radius * 3)
    for k in range(count):
        x, y = (int(v) for v in rng.integers(0, size, 2))
        axes = (int(rng.integers(radius // 2, radius + 1)), int(rng.integers(radius // 4, radius // 2 + 1)))
        tone = float(rng.normal(45 + 65 * k / count, 18))
        angle = float(rng.uniform(0, 180))
        for dx in (0, size if x < radius else -size if x > size - radius else 0):
            for dy in (0, size if y < radius else -size if y > size - radius else 0):
                cv2.ellipse(out, (x + dx, y + dy), axes, angle, 0, 360, tone, -1)
    return _finish(out)


def clouds(rng: Rng, size: int = 512) -> Grey:
    """A bright sky."""
    return _finish(232 + 14 * np.tanh(noise(rng, size, 4, 5, 0.45)))


def _write(rng: Rng, out: Floats, x: int, y: int, height: int, width: int, tone: float) -> None:
    """A line of capital letters and figures from (x, y), its lower left corner."""
    import cv2

    letters = rng.choice(list("ABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789   "), 60)
    scale, end = height / 22, 0
    while end < len(letters):
        size = cv2.getTextSize("".join(letters[: end + 1]), cv2.FONT_HERSHEY_DUPLEX, scale, 1)[0]
        if size[0] > width:
            break
        end += 1
    thickness = max(1, round(height / 12))
    mask = np.zeros(out.shape, np.uint8)
    cv2.putText(mask, "".join(letters[:end]), (x, y), cv2.FONT_HERSHEY_DUPLEX, scale, 255, thickness, cv2.LINE_AA)
    out += mask / np.float32(255) * (tone - out)


def poster(rng: Rng, width: int = 256, height: int = 256) -> Grey:
    """A headline, a picture, lines of text."""
    import cv2

    paper, ink = (rng.uniform(200, 245), rng.uniform(15, 70))
    if rng.random() < 0.3:
        paper, ink = ink + 20, paper
    out = np.full((height, width), paper, np.float32)
    margin = width // 16
    split = int(height * rng.uniform(0.5, 0.75))
    out[height // 7 : split, margin:-margin] = picture(rng, 256)[: split - height // 7, : width - 2 * margin] if (
        width <= 256 and split - height // 7 <= 256
    ) else rng.uniform(60, 200)  # fmt: skip
    if width > 256 or split - height // 7 > 256:
        inside = cv2.resize(picture(rng, 256), (width - 2 * margin, split - height // 7))
        out[height // 7 : split, margin:-margin] = inside
    _write(rng, out, margin, height // 9, height // 11, width - 2 * margin, ink)
    y = split + height // 16
    while y < height - margin:
        size = int(rng.choice([height // 26, height // 20, height // 16]))
        _write(rng, out, margin, y, max(size, 6), int((width - 2 * margin) * rng.uniform(0.6, 1)), ink)
        y += int(1.7 * max(size, 6))
    cv2.rectangle(out, (0, 0), (width - 1, height - 1), float(ink), max(1, width // 128))
    return _finish(out)


def picture(rng: Rng, size: int = 256) -> Grey:
    """A painting: overlapping shapes with flat and shaded fills."""
    import cv2

    out = (120 + 45 * noise(rng, size, 2, 3, 0.4)).astype(np.float32)
    for _ in range(22):
        x, y = (int(v) for v in rng.integers(0, size, 2))
        tone = float(rng.uniform(10, 245))
        kind, extent = rng.integers(0, 3), int(rng.integers(size // 24, size // 4))
        if kind == 0:
            cv2.ellipse(
                out, (x, y), (extent, max(extent // 2, 2)), float(rng.uniform(0, 180)), 0, 360, tone, -1, cv2.LINE_AA
            )
        elif kind == 1:
            corners = np.array([[x, y]]) + rng.integers(-extent, extent + 1, (int(rng.integers(3, 6)), 2))
            cv2.fillPoly(out, [corners.astype(np.int32)], tone, cv2.LINE_AA)
        else:
            end = (x + int(rng.integers(-2 * extent, 2 * extent)), y + int(rng.integers(-2 * extent, 2 * extent)))
            cv2.line(out, (x, y), end, tone, int(rng.integers(1, 6)), cv2.LINE_AA)
    return _finish(out + 3 * noise(rng, size, 32, 3))


def books(rng: Rng, width: int = 512, height: int = 512, shelves: int = 4) -> Grey:
    """A bookcase."""
    out = np.full((height, width), 45, np.float32)
    each, board = height // shelves, height // 48
    for k in range(shelves):
        bottom, x = (k + 1) * each - board, board
        out[bottom : bottom + board] = 150
        while x < width - board:
            thick = int(rng.integers(width // 64, width // 20))
            if rng.random() < 0.12:
                x += 2 * thick
                continue
            high = int(each * rng.uniform(0.55, 0.86))
            tone = rng.uniform(30, 225)
            right = min(x + thick, width - board)
            out[bottom - high : bottom, x:right] = tone
            out[bottom - high : bottom, right - 1 : right] = tone * 0.5
            for _ in range(int(rng.integers(1, 4))):  # bands and labels on the spine
                at = bottom - int(high * rng.uniform(0.1, 0.9))
                out[at : at + int(rng.integers(2, 12)), x + 1 : right - 1] = rng.uniform(20, 240)
            x += thick
    out[:, :board] = out[:, -board:] = 140
    out[:board] = 150
    return _finish(out + 2 * noise(rng, max(width, height), 32, 3)[:height, :width])


def drawers(rng: Rng, width: int = 256, height: int = 256, rows: int = 3, columns: int = 2, tone: float = 150) -> Grey:
    """A cupboard: doors with gaps between them and handles."""
    out = (tone + 3 * noise(rng, max(width, height), 8, 4)[:height, :width]).astype(np.float32)
    for r in range(rows):
        for c in range(columns):
            x0, x1 = c * width // columns, (c + 1) * width // columns - 1
            y0, y1 = r * height // rows, (r + 1) * height // rows - 1
            out[y0 : y0 + 2, x0:x1] -= 70
            out[y0:y1, x0 : x0 + 2] -= 70
            out[y0 + 3 : y0 + 5, x0 + 3 : x1] += 12
            cx, cy = (x0 + x1) // 2, y0 + (y1 - y0) // 4
            out[cy : cy + 5, cx - width // 16 : cx + width // 16] = 60
            out[cy + 5 : cy + 7, cx - width // 16 : cx + width // 16] -= 30
    return _finish(out)


def carton(rng: Rng, size: int = 256) -> Grey:
    """A cardboard box: tape, a label, some print."""
    out = (130 + 4 * noise(rng, size, 16, 4)).astype(np.float32)
    middle = size // 2
    out[middle - 10 : middle + 10] += 28
    x, y = (int(v) for v in rng.integers(16, size // 2, 2))
    out[y : y + size // 4, x : x + size // 3] = 225
    for k in range(4):
        _write(rng, out, x + 5, y + 14 + k * size // 18, 10, size // 3 - 10, 30.0)
    _write(rng, out, size // 8, size - size // 8, int(rng.integers(14, 34)), size * 3 // 4, 50.0)
    out[:2] = out[-2:] = out[:, :2] = out[:, -2:] = 85
    return _finish(out)


def screen(rng: Rng, width: int = 256, height: int = 256) -> Grey:
    """A monitor with windows of text."""
    out = np.full((height, width), 35, np.float32)
    out[10:-10, 8:-8] = 90
    for _ in range(3):
        x, y = int(rng.integers(12, width // 2)), int(rng.integers(14, height // 2))
        w, h = int(rng.integers(width // 4, width // 2 - 16)), int(rng.integers(height // 4, height // 2 - 20))
        out[y : y + h, x : x + w] = rng.choice([30.0, 225.0])
        out[y : y + 8, x : x + w] = 140
        for line in range(y + 20, y + h - 3, 12):
            _write(rng, out, x + 4, line, 8, int((w - 8) * rng.uniform(0.3, 1)), 130.0)
    return _finish(out)


def machine(rng: Rng, size: int = 512) -> Grey:
    """The side of a machine: plates, bolts, gauges, grilles, signs."""
    import cv2

    out = (110 + 5 * noise(rng, size, 8, 5)).astype(np.float32)
    for _ in range(9):
        x, y = (int(v) for v in rng.integers(0, size - 80, 2))
        w, h = (int(v) for v in rng.integers(50, 200, 2))
        x1, y1 = min(x + w, size - 4), min(y + h, size - 4)
        tone, kind = float(rng.uniform(50, 200)), rng.integers(0, 4)
        cv2.rectangle(out, (x, y), (x1, y1), tone, -1)
        cv2.rectangle(out, (x, y), (x1, y1), 30.0, 2)
        if kind == 0:
            out[y + 6 : y1 - 4 : 10, x + 6 : x1 - 6] = 25
        elif kind == 1:
            _write(rng, out, x + 6, (y + y1) // 2, 22, x1 - x - 12, 20.0 if tone > 120 else 230.0)
        elif kind == 2:
            radius = max(min(x1 - x, y1 - y) // 3, 4)
            centre = ((x + x1) // 2, (y + y1) // 2)
            cv2.circle(out, centre, radius, 235.0, -1, cv2.LINE_AA)
            cv2.circle(out, centre, radius, 20.0, 3, cv2.LINE_AA)
            tip = (centre[0] + int(rng.integers(-radius, radius) * 0.6), centre[1] - radius // 2)
            cv2.line(out, centre, tip, 10.0, 2, cv2.LINE_AA)
        for bx, by in ((x + 7, y + 7), (x1 - 7, y + 7), (x + 7, y1 - 7), (x1 - 7, y1 - 7)):
            cv2.circle(out, (bx, by), 3, 210.0, -1, cv2.LINE_AA)
    return _finish(out)


def window(rng: Rng, width: int = 256, height: int = 256) -> Grey:
    """A bright window with a frame and a bar or two."""
    out = np.tile(np.linspace(235, 190, height, dtype=np.float32)[:, None], (1, width))
    bar = width // 32
    out[-(height // 3) :] -= 40 * (noise(rng, max(width, height), 16, 3)[: height // 3, :width] > 0)
    for x in (0, width // 2 - bar, width - 2 * bar):
        out[:, x : x + 2 * bar] = 140
    for y in (0, height // 3, height - 2 * bar):
        out[y : y + 2 * bar] = 140
    return _finish(out)


def facade(rng: Rng, size: int = 1024) -> Grey:
    """A house front, shown once: rows of windows, sills, a plinth, a door or a shop, pipes."""
    style = rng.integers(0, 4)
    if style == 0:
        out = bricks(rng, size, 96, 32).astype(np.float32)
    elif style == 1:
        out = (rng.uniform(130, 185) + 3 * noise(rng, size, 8, 3) + 3 * noise(rng, size, 256, 2)).astype(np.float32)
        joint = size // int(rng.integers(24, 48))
        out[::joint] -= 18
    else:
        out = (rng.uniform(110, 200) + 4 * noise(rng, size, 16, 3, 0.7)).astype(np.float32)
    rows, columns = int(rng.integers(2, 5)), int(rng.integers(3, 7))
    wide, high = size // columns, int(size * 0.78) // rows
    w, h = int(wide * rng.uniform(0.35, 0.6)), int(high * rng.uniform(0.5, 0.7))
    panes = int(rng.integers(1, 4))
    frame = float(rng.choice([230.0, 60.0, 200.0]))
    for r in range(rows):
        for c in range(columns):
            if rng.random() > 0.06:
                x, y = c * wide + (wide - w) // 2, int(size * 0.04) + r * high + (high - h) // 2
                _facade_window(rng, out, x, y, w, h, panes, frame)
    plinth = int(size * 0.93)
    out[plinth:] = 90 + 4 * np.tile(noise(rng, size // 4, 8, 4), (1, 4))[: size - plinth]
    _ground_floor(rng, out, wide, w)
    x = int(rng.integers(4, size - 16))
    out[:, x : x + 7], out[:, x + 7 : x + 10] = 80, 120
    out[: size // 60] = 70
    return _finish(out)


def _facade_window(rng: Rng, out: Floats, x: int, y: int, w: int, h: int, panes: int, frame: float) -> None:
    out[y - 5 : y + h + 5, x - 5 : x + w + 5] = frame
    out[y + h + 5 : y + h + 13, x - 12 : x + w + 12] = 205
    out[y + h + 13 : y + h + 17, x - 12 : x + w + 12] -= 50
    glass = np.linspace(rng.uniform(50, 110), rng.uniform(25, 60), h, dtype=np.float32)[:, None]
    out[y : y + h, x : x + w] = glass
    if rng.random() < 0.5:  # curtain or blind
        drop = int(h * rng.uniform(0.2, 1.0))
        out[y : y + drop, x : x + w] = rng.uniform(120, 210)
        out[y : y + drop : int(rng.integers(6, 14)), x : x + w] -= 25
    elif rng.random() < 0.5:  # what the pane reflects
        cut = int(w * rng.uniform(0.2, 0.8))
        out[y + h // 3 : y + h, x : x + cut] += rng.uniform(15, 60)
    for p in range(1, panes):
        out[y : y + h, x + p * w // panes - 2 : x + p * w // panes + 3] = frame
    out[y + h // 3 - 2 : y + h // 3 + 2, x : x + w] = frame


def _ground_floor(rng: Rng, out: Floats, wide: int, w: int) -> None:
    size = len(out)
    top, columns = int(size * 0.8), size // wide
    at = int(rng.integers(0, columns)) * wide + (wide - w) // 2
    if rng.random() < 0.35:  # a shop
        out[top - size // 20 : size - 8, wide // 3 : -wide // 3] = rng.uniform(30, 70)
        out[top - size // 20 : top, wide // 3 : -wide // 3] = rng.uniform(90, 230)
        _write(rng, out, wide // 2, top - 10, size // 28, size // 2, 20.0)
        for x in range(wide // 2, size - wide // 2, wide // 2):
            goods = picture(rng, 256)[: int(size * 0.11), : wide // 3]
            out[top + 20 : top + 20 + goods.shape[0], x : x + goods.shape[1]] = 0.7 * goods
    tone = rng.uniform(40, 120)
    out[top:size, at : at + w] = 215
    out[top + 8 : size, at + 8 : at + w - 8] = tone
    out[top + 24 : top + 80, at + 20 : at + w - 20] = tone * 0.6
    out[top + 100 : size - 20, at + 20 : at + w - 20] = tone * 1.2


def car_side(rng: Rng, width: int = 512, height: int = 128) -> Grey:
    """The lower body of a car: doors, handles, wheels."""
    import cv2

    tone = float(rng.choice([30, 70, 120, 175, 225]))
    out = np.tile(np.linspace(min(tone * 1.15, 250), tone * 0.7, height, dtype=np.float32)[:, None], (1, width))
    out[int(height * 0.8) :] = 35
    for x in (int(width * 0.30), int(width * 0.5), int(width * 0.7)):
        out[: int(height * 0.8), x : x + 3] = tone * 0.4
        out[20:26, x + 12 : x + 40] = tone * 0.5
    for x in (int(width * 0.18), int(width * 0.82)):
        cv2.circle(out, (x, int(height * 0.72)), int(height * 0.36), 18.0, -1, cv2.LINE_AA)
        cv2.circle(out, (x, int(height * 0.72)), int(height * 0.22), 165.0, -1, cv2.LINE_AA)
        for k in range(5):
            angle = 2 * np.pi * k / 5 + 0.3
            tip = (int(x + height * 0.2 * np.cos(angle)), int(height * 0.72 + height * 0.2 * np.sin(angle)))
            cv2.line(out, (x, int(height * 0.72)), tip, 60.0, 4, cv2.LINE_AA)
    return _finish(out)


def car_end(rng: Rng, width: int = 256, height: int = 128) -> Grey:
    """Front or back of a car: lamps, grille, number plate."""
    tone = float(rng.choice([30, 70, 120, 175, 225]))
    out = np.full((height, width), tone, np.float32)
    out[int(height * 0.75) :] = 40
    out[20:55, 8:60], out[20:55, -60:-8] = 205, 205
    out[28:48, 16:40], out[28:48, -40:-16] = 120, 120
    out[30:60, 75:-75] = 45
    out[34:58:6, 75:-75] = 110
    out[70:92, 90:-90] = 235
    _write(rng, out, 96, 88, 15, width - 192, 20.0)
    return _finish(out)


def car_glass(rng: Rng, width: int = 256, height: int = 64) -> Grey:
    """The windows of a car between its pillars."""
    out = np.tile(np.linspace(95, 35, height, dtype=np.float32)[:, None], (1, width))
    out[:8] = 120
    for x in (0, int(width * 0.48), width - 12):
        out[:, x : x + 12] = 90
    out[20:, int(rng.integers(20, width // 3)) : int(rng.integers(width // 2, width - 20))] += rng.uniform(10, 40)
    return _finish(out)


def sign(rng: Rng, size: int = 128) -> Grey:
    """A traffic sign or a name plate."""
    import cv2

    out = np.full((size, size), 230, np.float32)
    kind = rng.integers(0, 3)
    if kind == 0:
        cv2.circle(out, (size // 2, size // 2), size * 2 // 5, 60.0, size // 10, cv2.LINE_AA)
        _write(rng, out, size // 4, size * 5 // 8, size // 3, size // 2, 20.0)
    elif kind == 1:
        cv2.fillPoly(out, [np.array([[size // 2, 10], [size - 10, size - 16], [10, size - 16]])], 70.0, cv2.LINE_AA)
        _write(rng, out, size * 3 // 8, size * 3 // 4, size // 4, size // 3, 240.0)
    else:
        out[:] = 50
        _write(rng, out, 8, size // 2, size // 4, size - 16, 240.0)
        _write(rng, out, 8, size * 7 // 8, size // 4, size - 16, 240.0)
    cv2.rectangle(out, (0, 0), (size - 1, size - 1), 20.0, 3)
    return _finish(out)
