"""Features and matches in COLMAP 4.2's SQLite schema: COLMAP's own tools open what we write, and we what they write.

Four tables of ours stand beside COLMAP's, which ignores them: ``sfmapp_features`` holds the colour under each
keypoint, ``sfmapp_pairs`` the counts of verification, and both the key under which a row was computed, for resuming;
``sfmapp_descriptors`` holds the metric of descriptors that are not SIFT's, ``sfmapp_signs`` which keypoints are dark,
where that is known.

COLMAP's table of descriptors holds bytes. Floats stand in it as COLMAP writes those of ALIKED and LOMA: the bytes of
little-endian float32, four columns each.
"""

from __future__ import annotations

import os
import sqlite3
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sfmapp.camera.camera import Camera
from sfmapp.errors import InputError
from sfmapp.formats.colmap_model import checked_camera
from sfmapp.scene.correspondences import Correspondences, TwoViewConfig
from sfmapp.scene.features import DescriptorMetric, Features

_VERSION = 4020100
"""COLMAP 4.2.1's own mark, in the pragma user_version: an older one would make it migrate the file."""

_MAX_IMAGES = 2**31 - 1
_CAMERA_SENSOR = 0
# COLMAP's types of descriptors: what has no type there, and those of ALIKED and LOMA, which are floats
_SIFT, _UNDEFINED, _FLOATS = 0, -1, (1, 2, 3, 4)
_SIFT_LENGTH, _ORB_LENGTH = 128, 32
_WGS84 = 0
_CALIBRATED_RIG = 9

# COLMAP reads columns by position: their order is part of the format.
_SCHEMA = """
CREATE TABLE rigs (
    rig_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
    ref_sensor_id INTEGER NOT NULL,
    ref_sensor_type INTEGER NOT NULL);
CREATE UNIQUE INDEX rig_ref_sensor_assignment ON rigs (ref_sensor_id, ref_sensor_type);
CREATE TABLE rig_sensors (
    rig_id INTEGER NOT NULL,
    sensor_id INTEGER NOT NULL,
    sensor_type INTEGER NOT NULL,
    sensor_from_rig BLOB,
    FOREIGN KEY (rig_id) REFERENCES rigs (rig_id) ON DELETE CASCADE);
CREATE UNIQUE INDEX rig_sensor_assignment ON rig_sensors (sensor_id, sensor_type);
CREATE TABLE cameras (
    camera_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
    model INTEGER NOT NULL,
    width INTEGER NOT NULL,
    height INTEGER NOT NULL,
    params BLOB,
    prior_focal_length INTEGER NOT NULL);
CREATE TABLE frames (
    frame_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
    rig_id INTEGER NOT NULL,
    FOREIGN KEY (rig_id) REFERENCES rigs (rig_id) ON DELETE CASCADE);
CREATE TABLE frame_data (
    frame_id INTEGER NOT NULL,
    data_id INTEGER NOT NULL,
    sensor_id INTEGER NOT NULL,
    sensor_type INTEGER NOT NULL,
    FOREIGN KEY (frame_id) REFERENCES frames (frame_id) ON DELETE CASCADE);
CREATE UNIQUE INDEX frame_sensor_assignment ON frame_data (data_id, sensor_type);
CREATE TABLE images (
    image_id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
    name TEXT NOT NULL UNIQUE,
    camera_id INTEGER NOT NULL,
    CONSTRAINT image_id_check CHECK (image_id >= 0 AND image_id < 2147483647),
    FOREIGN KEY (camera_id) REFERENCES cameras (camera_id));
CREATE UNIQUE INDEX index_name ON images (name);
CREATE TABLE pose_priors (
    pose_prior_id INTEGER PRIMARY KEY NOT NULL,
    corr_data_id INTEGER NOT NULL,
    corr_sensor_id INTEGER NOT NULL,
    corr_sensor_type INTEGER NOT NULL,
    position BLOB,
    position_covariance BLOB,
    gravity BLOB,
    coordinate_system INTEGER NOT NULL);
CREATE UNIQUE INDEX pose_prior_data_assignment ON pose_priors (corr_data_id, corr_sensor_id, corr_sensor_type);
CREATE TABLE keypoints (
    image_id INTEGER PRIMARY KEY NOT NULL,
    rows INTEGER NOT NULL,
    cols INTEGER NOT NULL,
    data BLOB,
    FOREIGN KEY (image_id) REFERENCES images (image_id) ON DELETE CASCADE);
CREATE TABLE descriptors (
    image_id INTEGER PRIMARY KEY NOT NULL,
    type INTEGER NOT NULL,
    rows INTEGER NOT NULL,
    cols INTEGER NOT NULL,
    data BLOB,
    FOREIGN KEY (image_id) REFERENCES images (image_id) ON DELETE CASCADE);
CREATE TABLE matches (
    pair_id INTEGER PRIMARY KEY NOT NULL,
    rows INTEGER NOT NULL,
    cols INTEGER NOT NULL,
    data BLOB);
CREATE TABLE two_view_geometries (
    pair_id INTEGER PRIMARY KEY NOT NULL,
    rows INTEGER NOT NULL,
    cols INTEGER NOT NULL,
    data BLOB,
    config INTEGER NOT NULL,
    F BLOB,
    E BLOB,
    H BLOB,
    qvec BLOB,
    tvec BLOB,
    camera1 BLOB,
    camera2 BLOB);
"""
_OWN_SCHEMA = """
CREATE TABLE IF NOT EXISTS sfmapp_features (
    image_id INTEGER PRIMARY KEY NOT NULL, key TEXT NOT NULL, rgb BLOB NOT NULL);
CREATE TABLE IF NOT EXISTS sfmapp_descriptors (image_id INTEGER PRIMARY KEY NOT NULL, metric TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS sfmapp_signs (image_id INTEGER PRIMARY KEY NOT NULL, is_dark BLOB NOT NULL);
CREATE TABLE IF NOT EXISTS sfmapp_pairs (
    pair_id INTEGER PRIMARY KEY NOT NULL, key TEXT NOT NULL, num_putative INTEGER NOT NULL,
    num_inliers_f INTEGER NOT NULL, num_inliers_e INTEGER NOT NULL, num_inliers_h INTEGER NOT NULL,
    median_angle_deg REAL);
"""
_IMAGE_TABLES = ("keypoints", "descriptors", "sfmapp_features", "sfmapp_descriptors", "sfmapp_signs")
_PAIR_TABLES = ("matches", "two_view_geometries", "sfmapp_pairs")


class Database:
    """An open database; also a context manager that closes it.

    What is written is committed at once and survives a killed process. While the database is open for writing SQLite
    keeps a log beside it (WAL); after :meth:`close` it is one file again. Images go by position, those of COLMAP by id:
    positions count the ids upwards, and what we write has id = position + 1. All methods may be called from any thread.

    Args:
        path: the file; made with its schema if it does not exist.
        read_only: refuse to make or change anything; databases of older COLMAP versions can be read as well.

    Raises:
        InputError: the file is missing (read_only), no SQLite database, or of an older schema (for writing).
    """

    def __init__(self, path: str | Path, *, read_only: bool = False) -> None:
        self.path = Path(path)
        self._lock = threading.RLock()
        if read_only and not self.path.is_file():
            raise InputError(f"{self.path}: expected a COLMAP database, found no such file")
        with self._named_errors():
            mode = "mode=ro" if read_only else "mode=rwc"
            if read_only and not os.access(self.path.absolute().parent, os.W_OK):
                mode = "immutable=1"  # COLMAP leaves files in a mode whose readers want to write a lock beside them
            uri = f"{self.path.absolute().as_uri()}?{mode}"
            self._db = sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)
            try:
                if not read_only:
                    self._prepare()
                self._tables = {name for (name,) in self._db.execute("SELECT name FROM sqlite_master")}
                columns = [row[1] for row in self._db.execute("PRAGMA table_info(descriptors)")]
                # older versions of COLMAP say nothing about the type, and hold SIFT
                self._type_column = "type" if "type" in columns else str(_SIFT)
                if "images" not in self._tables:
                    raise InputError(f"{self.path}: expected a COLMAP database, found no table of images")
                self._know([image_id for (image_id,) in self._db.execute("SELECT image_id FROM images ORDER BY 1")])
            except BaseException:
                self._db.close()
                raise

    def _prepare(self) -> None:
        # with the log, a commit costs no wait for the disk, and a crash loses at most the last commits
        self._db.execute("PRAGMA journal_mode = WAL")
        self._db.execute("PRAGMA synchronous = NORMAL")
        version = self._db.execute("PRAGMA user_version").fetchone()[0]
        tables = self._db.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
        if tables and version < _VERSION:
            raise InputError(
                f"{self.path}: expected a database of COLMAP 4.2 or newer ({_VERSION}), found version {version}",
                "open it once with COLMAP 4.2, or choose another output folder",
            )
        statements = _OWN_SCHEMA if tables else f"{_SCHEMA}{_OWN_SCHEMA}PRAGMA user_version = {_VERSION};"
        self._db.executescript(f"BEGIN;{statements}COMMIT;")

    def close(self) -> None:
        """Fold the log into the file and close it. Calling it again does nothing."""
        # folding fails where somebody else has the database open, who will then do it
        with self._lock, suppress(sqlite3.Error):
            self._db.execute("PRAGMA journal_mode = DELETE")
        self._db.close()

    def __enter__(self) -> Database:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @contextmanager
    def _named_errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.OperationalError as error:
            raise InputError(f"{self.path}: {error}", "close other programs that use it, check disk space") from error
        except sqlite3.Error as error:
            raise InputError(f"{self.path}: expected a COLMAP database, found: {error}") from error

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        with self._lock, self._named_errors():
            yield self._db

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        """One transaction: all or nothing."""
        with self._lock, self._named_errors():
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield self._db
            except BaseException:
                self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")

    # images ------------------------------------------------------------------------------------------------------

    def set_images(
        self,
        cameras: Sequence[Camera],
        image_names: Sequence[str],
        image_camera_idx: Sequence[int] | NDArray[np.integer],
        gps: Sequence[tuple[float, float, float] | None] | None = None,
    ) -> None:
        """State which images there are. Features and pairs of names that stay are kept, under their new positions.

        Args:
            cameras: intrinsics; a focal length that comes from anywhere but the default counts as a prior.
            image_names: unique, relative to the image folder.
            image_camera_idx: (I,) positions in cameras.
            gps: latitude and longitude in degrees (WGS84) and altitude in metres of each image, or None.
        """
        camera_ids = [int(idx) + 1 for idx in image_camera_idx]
        image_ids = list(range(1, len(image_names) + 1))
        with self._writing() as db:
            old_ids = dict(db.execute("SELECT name, image_id FROM images"))
            if [old_ids.get(name) for name in image_names] != image_ids or len(old_ids) != len(image_ids):
                self._move(
                    {old_ids[name]: new for name, new in zip(image_names, image_ids, strict=True) if name in old_ids}
                )
            for table in ("frame_data", "frames", "rig_sensors", "rigs", "pose_priors", "images", "cameras"):
                db.execute(f"DELETE FROM {table}")
            db.executemany(
                "INSERT INTO cameras VALUES (?, ?, ?, ?, ?, ?)",
                [
                    (i, int(c.model), c.width, c.height, _blob(c.params, "<f8"), int(c.focal_source != "default"))
                    for i, c in enumerate(cameras, 1)
                ],
            )
            # COLMAP mounts every camera on a rig: alone, one frame per image
            db.executemany(
                "INSERT INTO rigs VALUES (?, ?, ?)", [(i, i, _CAMERA_SENSOR) for i in range(1, len(cameras) + 1)]
            )
            db.executemany("INSERT INTO images VALUES (?, ?, ?)", zip(image_ids, image_names, camera_ids, strict=True))
            db.executemany("INSERT INTO frames VALUES (?, ?)", zip(image_ids, camera_ids, strict=True))
            db.executemany(
                "INSERT INTO frame_data VALUES (?, ?, ?, ?)",
                [(i, i, c, _CAMERA_SENSOR) for i, c in zip(image_ids, camera_ids, strict=True)],
            )
            unknown = np.full(9, np.nan)
            db.executemany(
                "INSERT INTO pose_priors VALUES (?, ?, ?, ?, ?, ?, ?, ?)",
                [
                    (i, i, camera_ids[i - 1], _CAMERA_SENSOR, _blob(position, "<f8"), _blob(unknown, "<f8"),
                     _blob(unknown[:3], "<f8"), _WGS84)
                    for i, position in enumerate(gps or [], 1)
                    if position is not None
                ],
            )  # fmt: skip
        self._know(image_ids)

    def _know(self, image_ids: list[int]) -> None:
        self._image_ids = image_ids
        self._positions = {image_id: idx for idx, image_id in enumerate(image_ids)}

    def _move(self, new_ids: dict[int, int]) -> None:
        """Give the rows of images and pairs their new ids; drop those without one. Runs inside a transaction."""
        db = self._db
        for table, column in [(t, "image_id") for t in _IMAGE_TABLES] + [(t, "pair_id") for t in _PAIR_TABLES]:
            for (old,) in db.execute(f"SELECT {column} FROM {table}").fetchall():
                ids = [new_ids.get(i) for i in ([old] if column == "image_id" else _images_of_pair(old))]
                # a pair whose images change their order would have to be turned round: it is computed again
                if None in ids or ids != sorted(ids):  # type: ignore[type-var]
                    db.execute(f"DELETE FROM {table} WHERE {column} = ?", (old,))
                else:
                    new = ids[0] if column == "image_id" else _pair_id(*ids)  # type: ignore[arg-type]
                    # negative while old and new ids live side by side
                    db.execute(f"UPDATE {table} SET {column} = ? WHERE {column} = ?", (-new, old))  # type: ignore[operator]
            db.execute(f"UPDATE {table} SET {column} = -{column}")

    def read_images(self) -> tuple[list[Camera], list[str], NDArray[np.int32]]:
        """Cameras, image names and the camera position (I,) int32 of each image.

        Raises:
            InputError: a camera or a reference to one is malformed.
        """
        with self._reading() as db:
            camera_rows = db.execute(
                "SELECT camera_id, model, width, height, params, prior_focal_length FROM cameras ORDER BY 1"
            ).fetchall()
            image_rows = db.execute("SELECT name, camera_id FROM images ORDER BY image_id").fetchall()
        cameras: list[Camera] = []
        position: dict[int, int] = {}
        for camera_id, model, width, height, params, has_prior in camera_rows:
            if not isinstance(params, bytes) or len(params) % 8:
                raise InputError(f"{self.path}: camera {camera_id}: expected its parameters as a blob of float64")
            camera = checked_camera(self.path, camera_id, model, width, height, np.frombuffer(params, "<f8"))
            position[camera_id] = len(cameras)
            source = "file" if has_prior else "default"
            cameras.append(Camera(camera.model, camera.width, camera.height, camera.params, focal_source=source))
        for name, camera_id in image_rows:
            if camera_id not in position:
                raise InputError(
                    f"{self.path}: image {name!r} names camera {camera_id}, which the database does not hold"
                )
        return (
            cameras,
            [str(row[0]) for row in image_rows],
            np.array([position[row[1]] for row in image_rows], np.int32),
        )

    # features ----------------------------------------------------------------------------------------------------

    def write_features(self, image_idx: int, features: Features, key: str = "") -> None:
        """Store the features of one image in place of what there was; they are read back as they are.

        COLMAP knows descriptors of the metric ``root_sift`` as SIFT; others are of type UNDEFINED to it, and are bytes:
        it can show and match keypoints that have verified pairs, but not compare such descriptors.

        Args:
            image_idx: position of the image.
            key: whatever identifies the inputs and options that they were computed from.
        """
        image_id = self._image_ids[image_idx]
        keypoints, descriptors, metric = features.keypoints, features.descriptors, features.metric
        is_sift, is_float = metric == DescriptorMetric.ROOT_SIFT, metric == DescriptorMetric.L2
        size = 4 if is_float else 1
        shape = (len(descriptors), descriptors.shape[1] * size)
        with self._writing() as db:
            db.execute(
                "INSERT OR REPLACE INTO keypoints VALUES (?, ?, ?, ?)",
                (image_id, *keypoints.shape, _blob(keypoints, "<f4")),
            )
            db.execute(
                "INSERT OR REPLACE INTO descriptors VALUES (?, ?, ?, ?, ?)",
                (image_id, _SIFT if is_sift else _UNDEFINED, *shape, _blob(descriptors, "<f4" if is_float else "u1")),
            )
            db.execute("DELETE FROM sfmapp_descriptors WHERE image_id = ?", (image_id,))
            if not is_sift:
                db.execute("INSERT INTO sfmapp_descriptors VALUES (?, ?)", (image_id, str(metric)))
            db.execute("DELETE FROM sfmapp_signs WHERE image_id = ?", (image_id,))
            if features.is_dark is not None:
                db.execute("INSERT INTO sfmapp_signs VALUES (?, ?)", (image_id, _blob(features.is_dark, "u1")))
            db.execute(
                "INSERT OR REPLACE INTO sfmapp_features VALUES (?, ?, ?)", (image_id, key, _blob(features.rgb, "u1"))
            )

    def feature_keys(self) -> dict[int, str]:
        """Key by image position, of all images whose features are stored by us."""
        if "sfmapp_features" not in self._tables:
            return {}
        with self._reading() as db:
            keys = dict(db.execute("SELECT image_id, key FROM sfmapp_features"))
        return {idx: keys[image_id] for idx, image_id in enumerate(self._image_ids) if image_id in keys}

    def read_features(self, image_idx: int) -> Features:
        """The features of one image. Colours that are not stored (a database of COLMAP's) are black.

        Raises:
            InputError: there are none, or a blob is malformed.
        """
        image_id = self._image_ids[image_idx]
        what = f"image {image_id}"
        with self._reading():
            keypoint_row = self._one("keypoints", "image_id", "rows, cols, data", image_id)
            descriptor_row = self._one("descriptors", "image_id", f"{self._type_column}, rows, cols, data", image_id)
            metric_row = self._one("sfmapp_descriptors", "image_id", "metric", image_id)
            rgb_row = self._one("sfmapp_features", "image_id", "rgb", image_id)
            sign_row = self._one("sfmapp_signs", "image_id", "is_dark", image_id)
        if keypoint_row is None or descriptor_row is None:
            raise InputError(f"{self.path}: expected keypoints and descriptors of {what}, found none")
        keypoints = _scale_and_orientation(self._table(f"keypoints of {what}", "<f4", (2, 4, 6), *keypoint_row))
        descriptors, metric = self._descriptors(f"descriptors of {what}", metric_row, *descriptor_row)
        if not np.isfinite(keypoints).all():
            raise InputError(f"{self.path}: keypoints of {what}: expected finite numbers, found NaN or infinity")
        if len(descriptors) != len(keypoints):
            raise InputError(
                f"{self.path}: {what}: expected a descriptor for each of {len(keypoints)} keypoints, found "
                f"{len(descriptors)}"
            )
        rgb = np.zeros((len(keypoints), 3), np.uint8)
        if rgb_row is not None:
            rgb = self._table(f"colours of {what}", "u1", (3,), len(keypoints), 3, *rgb_row)
        is_dark = None
        if sign_row is not None:
            is_dark = self._table(f"signs of {what}", "u1", (1,), len(keypoints), 1, *sign_row)[:, 0] != 0
        return Features(keypoints, descriptors, rgb, metric, is_dark)

    def _descriptors(
        self, what: str, metric_row: tuple[Any, ...] | None, kind: Any, rows: Any, cols: Any, data: Any
    ) -> tuple[NDArray[Any], DescriptorMetric]:
        """Descriptors and their metric: as we have noted it, else by COLMAP's type, else by their length."""
        if metric_row is not None:
            if metric_row[0] not in tuple(DescriptorMetric):
                raise InputError(f"{self.path}: {what}: expected a known metric, found {metric_row[0]!r}")
            metric = DescriptorMetric(metric_row[0])
        elif kind in _FLOATS:
            metric = DescriptorMetric.L2
        else:
            metric = DescriptorMetric.ROOT_SIFT if cols == _SIFT_LENGTH else DescriptorMetric.HAMMING
        if metric == DescriptorMetric.L2:
            allowed = (cols,) if isinstance(cols, int) and cols >= 0 and cols % 4 == 0 else (4,)
            floats = self._table(what, "u1", allowed, rows, cols, data).view("<f4")
            if not np.isfinite(floats).all():
                raise InputError(f"{self.path}: {what}: expected finite numbers, found NaN or infinity")
            return floats.astype(np.float32), metric
        if metric == DescriptorMetric.HAMMING and metric_row is not None and isinstance(cols, int) and cols >= 0:
            return self._table(what, "u1", (cols,), rows, cols, data), metric
        return self._table(what, "u1", (_ORB_LENGTH, _SIFT_LENGTH), rows, cols, data), metric

    def _one(self, table: str, column: str, columns: str, value: int) -> tuple[Any, ...] | None:
        if table not in self._tables:
            return None
        query = f"SELECT {columns} FROM {table} WHERE {column} = ?"
        row: tuple[Any, ...] | None = self._db.execute(query, (value,)).fetchone()
        return row

    def _table(
        self, what: str, dtype: str, allowed_cols: tuple[int, ...], rows: Any, cols: Any, data: Any
    ) -> NDArray[Any]:
        """A copy (rows, cols) of a blob, after checking its size."""
        if rows == 0 and not data:
            return np.zeros((0, cols if cols in allowed_cols else allowed_cols[0]), dtype)
        if not isinstance(rows, int) or rows < 0 or cols not in allowed_cols:
            raise InputError(f"{self.path}: {what}: expected {allowed_cols} columns, found {rows!r} x {cols!r}")
        size = rows * cols * np.dtype(dtype).itemsize
        if not isinstance(data, bytes) or len(data) != size:
            found = f"{len(data)} bytes" if isinstance(data, bytes) else type(data).__name__
            raise InputError(f"{self.path}: {what}: expected {size} bytes for {rows} x {cols}, found {found}")
        return np.frombuffer(data, dtype).reshape(rows, cols).copy()

    # pairs -------------------------------------------------------------------------------------------------------

    def write_pairs(self, pairs: Correspondences, key: str = "") -> None:
        """Store pairs, all of them in one transaction, in place of what there was for the same pairs.

        Both of COLMAP's tables of matches hold the inliers: the putative ones are not kept, but tools that verify
        matches anew start from the table ``matches`` and find something there.
        """
        match_rows, geometry_rows, own_rows = [], [], []
        for p, (i, j) in enumerate(pairs.pair_image_idx.tolist()):
            pair_id = _pair_id(self._image_ids[i], self._image_ids[j])
            matches = pairs.matches_of_pair(p)
            blob = _blob(matches, "<u4")
            pose = pairs.cam2_from_cam1[p]
            match_rows.append((pair_id, len(matches), 2, blob))
            geometry_rows.append(
                (pair_id, len(matches), 2, blob, int(pairs.config[p]), _blob_or_none(pairs.fundamental[p]),
                 _blob_or_none(pairs.essential[p]), _blob_or_none(pairs.homography[p]),
                 _blob_or_none(pose[[3, 0, 1, 2]]), _blob_or_none(pose[4:]))
            )  # fmt: skip
            angle = float(pairs.median_angle_deg[p])
            own_rows.append(
                (pair_id, key, int(pairs.num_putative[p]), int(pairs.num_inliers_f[p]), int(pairs.num_inliers_e[p]),
                 int(pairs.num_inliers_h[p]), angle)
            )  # fmt: skip
        with self._writing() as db:
            db.executemany("INSERT OR REPLACE INTO matches VALUES (?, ?, ?, ?)", match_rows)
            db.executemany(
                "INSERT OR REPLACE INTO two_view_geometries VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, NULL, NULL)",
                geometry_rows,
            )
            db.executemany("INSERT OR REPLACE INTO sfmapp_pairs VALUES (?, ?, ?, ?, ?, ?, ?)", own_rows)

    def clear_pairs(self) -> None:
        """Forget all pairs."""
        with self._writing() as db:
            for table in _PAIR_TABLES:
                db.execute(f"DELETE FROM {table}")

    def pair_keys(self) -> dict[tuple[int, int], str]:
        """Key by image positions (i, j), i < j, of all pairs that are stored by us."""
        if "sfmapp_pairs" not in self._tables:
            return {}
        with self._reading() as db:
            rows = db.execute("SELECT pair_id, key FROM sfmapp_pairs ORDER BY 1").fetchall()
        return {self._positions_of_pair(pair_id): key for pair_id, key in rows}

    def _positions_of_pair(self, pair_id: int) -> tuple[int, int]:
        position = self._positions
        first, second = _images_of_pair(pair_id)
        if first not in position or second not in position or first >= second:
            raise InputError(
                f"{self.path}: pair {pair_id}: expected two known images in ascending order, found {first} and {second}"
            )
        return position[first], position[second]

    def read_pairs(self, pair_image_idx: NDArray[np.integer] | None = None) -> Correspondences:
        """Stored pairs, sorted by image positions.

        Args:
            pair_image_idx: (P, 2) the wanted ones, each i < j, sorted; None for all. All have to be there.

        Raises:
            InputError: a wanted pair is missing, a blob is malformed, or a match names a keypoint that is not there.
        """
        query = (
            "SELECT pair_id, g.rows, g.cols, g.data, config, F, E, H, {pose}, m.rows, {own} FROM two_view_geometries g "
            "LEFT JOIN matches m USING (pair_id) {join} ORDER BY pair_id"
        )
        own = "num_putative, num_inliers_f, num_inliers_e, num_inliers_h, median_angle_deg"
        with self._reading() as db:
            columns = {row[1] for row in db.execute("PRAGMA table_info(two_view_geometries)")}
            has_own = "sfmapp_pairs" in self._tables
            rows = db.execute(
                query.format(
                    pose="qvec, tvec" if "qvec" in columns else "NULL, NULL",
                    own=own if has_own else "NULL, NULL, NULL, NULL, NULL",
                    join="LEFT JOIN sfmapp_pairs USING (pair_id)" if has_own else "",
                )
            ).fetchall()
            num_keypoints = dict(db.execute("SELECT image_id, rows FROM keypoints"))
        by_pair = {self._positions_of_pair(row[0]): row for row in rows}
        if pair_image_idx is None:
            wanted = sorted(by_pair)
        else:
            wanted = [(int(i), int(j)) for i, j in pair_image_idx]
            missing = [pair for pair in wanted if pair not in by_pair]
            if missing:
                raise InputError(f"{self.path}: expected the pair of images {missing[0]}, found none")
        rows_of = [num_keypoints.get(image_id, 0) for image_id in self._image_ids]
        if not all(isinstance(num, int) for num in rows_of):
            raise InputError(f"{self.path}: keypoints: expected whole numbers of rows, found other values")
        counts = np.array(rows_of, np.int64)
        return self._correspondences(wanted, [by_pair[pair] for pair in wanted], counts)

    def _correspondences(
        self, pairs: list[tuple[int, int]], rows: list[tuple[Any, ...]], num_keypoints: NDArray[np.int64]
    ) -> Correspondences:
        num = len(pairs)
        matches, config = [], np.zeros(num, np.int8)
        models, pose = np.full((3, num, 9), np.nan), np.full((num, 7), np.nan)
        counts, angle = np.zeros((4, num), np.int32), np.full(num, np.nan)
        for p, (pair, row) in enumerate(zip(pairs, rows, strict=True)):
            what = f"pair {pair}"
            inliers = self._table(f"matches of {what}", "<u4", (2,), *row[1:4])
            if len(inliers) and (inliers.max(0) >= num_keypoints[list(pair)]).any():
                raise InputError(
                    f"{self.path}: {what}: expected matches among {num_keypoints[list(pair)].tolist()} keypoints, "
                    f"found {inliers.max(0).tolist()}"
                )
            matches.append(inliers.astype(np.int32))
            config[p] = self._config(what, row[4])
            for k in range(3):
                models[k, p] = self._numbers(f"{'FEH'[k]} of {what}", 9, row[5 + k])
            quaternion = self._numbers(f"qvec of {what}", 4, row[8])
            pose[p] = np.concatenate([quaternion[[1, 2, 3, 0]], self._numbers(f"tvec of {what}", 3, row[9])])
            try:
                counts[:, p] = _counts(config[p], len(inliers), row[10]) if row[11] is None else row[11:15]
                angle[p] = np.nan if row[15] is None else row[15]
            except (TypeError, ValueError, OverflowError):
                raise InputError(f"{self.path}: {what}: expected counts and an angle, found {row[10:]}") from None
        lengths = [len(m) for m in matches]
        return Correspondences(
            pair_image_idx=np.array(pairs, np.int32).reshape(-1, 2),
            pair_ptr=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
            matches=np.concatenate([*matches, np.zeros((0, 2), np.int32)]),
            config=config,
            fundamental=models[0].reshape(-1, 3, 3),
            essential=models[1].reshape(-1, 3, 3),
            homography=models[2].reshape(-1, 3, 3),
            cam2_from_cam1=pose,
            median_angle_deg=angle,
            num_putative=counts[0],
            num_inliers_f=counts[1],
            num_inliers_e=counts[2],
            num_inliers_h=counts[3],
        )

    def _config(self, what: str, value: Any) -> int:
        if value == _CALIBRATED_RIG:  # verified with the pose of the whole rig: calibrated all the same
            return TwoViewConfig.CALIBRATED
        if value not in TwoViewConfig._value2member_map_:
            raise InputError(f"{self.path}: {what}: expected a configuration from 0 to 9, found {value!r}")
        return int(value)

    def _numbers(self, what: str, count: int, data: Any) -> NDArray[np.float64]:
        """(count,) float64 of a blob, NaN for NULL."""
        if data is None:
            return np.full(count, np.nan)
        if not isinstance(data, bytes) or len(data) != 8 * count:
            raise InputError(f"{self.path}: {what}: expected {count} float64 numbers, found something else")
        return np.frombuffer(data, "<f8")


def _counts(config: int, num_inliers: int, num_putative: int | None) -> tuple[int, int, int, int]:
    """Putative matches and inliers of F, E and H as far as a database of COLMAP's tells them."""
    planar = config in (TwoViewConfig.PLANAR, TwoViewConfig.PANORAMIC, TwoViewConfig.PLANAR_OR_PANORAMIC)
    return (
        num_inliers if num_putative is None else num_putative,
        num_inliers if config == TwoViewConfig.UNCALIBRATED else 0,
        num_inliers if config == TwoViewConfig.CALIBRATED else 0,
        num_inliers if planar else 0,
    )


def _pair_id(image_id: int, larger_image_id: int) -> int:
    return image_id * _MAX_IMAGES + larger_image_id


def _images_of_pair(pair_id: int) -> tuple[int, int]:
    # ids are below _MAX_IMAGES and the second is at least 1
    return divmod(pair_id, _MAX_IMAGES)


def _blob(values: Any, dtype: str) -> bytes:
    return np.ascontiguousarray(values, dtype).tobytes()


def _blob_or_none(values: NDArray[np.float64]) -> bytes | None:
    """Rows of float64, NULL where not estimated."""
    return None if np.isnan(values).any() else _blob(values, "<f8")


def _scale_and_orientation(keypoints: NDArray[np.float32]) -> NDArray[np.float32]:
    """(N, 4) x, y, scale, orientation from the 2, 4 or 6 columns that COLMAP stores; 6 hold a 2 x 2 affine shape."""
    if keypoints.shape[1] == 4:
        return keypoints
    out = np.zeros((len(keypoints), 4), np.float32)
    out[:, :2], out[:, 2] = keypoints[:, :2], 1.0
    if keypoints.shape[1] == 6:
        a11, a12, a21, a22 = keypoints[:, 2:].T
        out[:, 2] = (np.hypot(a11, a21) + np.hypot(a12, a22)) / 2
        out[:, 3] = np.arctan2(a21, a11)
    return out
