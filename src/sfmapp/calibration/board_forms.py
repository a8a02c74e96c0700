"""How boards are written on the command line, apart from all that is heavy: help texts show it."""

from __future__ import annotations

BOARD_FORMS = """\
boards:
  chessboard:COLSxROWS:SQUARE             inner corners, as OpenCV counts them; SQUARE in metres
  charuco:COLSxROWS:SQUARE:MARKER[:DICT]  squares; sides of squares and markers; DICT_4X4_50 without a name
  circles:COLSxROWS:SPACING               circles, between centres
  acircles:COLSxROWS:SPACING              OpenCV's asymmetric grid: COLS circles in each row, rows SPACING apart
  aprilgrid:COLSxROWS:TAG:GAP             Kalibr's: side of a tag, gap as a share of it; tag36h11
  FILE.yaml                               a target file of Kalibr's"""
