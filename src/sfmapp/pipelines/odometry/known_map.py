"""The map that a sequence is localised in: of an earlier odometry run, or a reconstruction of photographs."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sfmapp.dense.photographs import find_photographs
from sfmapp.errors import InputError, NoReconstructionError
from sfmapp.events import Events
from sfmapp.formats.colmap import has_model, read_model
from sfmapp.images.pixels import as_gray, read_gray
from sfmapp.images.sequence_source import SequenceSource
from sfmapp.odometry.loops.relocalize import RelocalizeOptions
from sfmapp.odometry.map.known_map import PREFIX, KnownMap, as_seen_by, is_same
from sfmapp.odometry.refinement.final_adjustment import rig_of
from sfmapp.pipelines.metres import metre_sigma_of_run
from sfmapp.pipelines.odometry.results import read_odometry
from sfmapp.pipelines.stored_pixels import has_stored_pixels
from sfmapp.scene.reconstruction import Reconstruction
from sfmapp.scene.rig import Rig
from sfmapp.sequences.open import open_sequence
from sfmapp.workspace.layout import MANIFEST, ODOMETRY, RECONSTRUCT, USUAL_FOLDERS
from sfmapp.workspace.manifest import image_root, missing_photographs, read_manifest
from sfmapp.workspace.options import Options, options_from_dict

STAGE = "known map"


@dataclass(frozen=True)
class ReadMap:
    """A known map, and the rig that the run which made it was given; None for photographs."""

    known: KnownMap
    given: Rig | None = None

    def rig_for(self, rig: Rig) -> Rig:
        """The rig of a sequence: where it is the one that the map's own run was given, as that run has found it to be,
        for otherwise its errors would be found again, and be held against the map."""
        num = len(rig.cameras)
        if self.given is None or len(self.given.cameras) < num:
            return rig
        if not all(is_same(a, b) for a, b in zip(rig.cameras, self.given.cameras, strict=False)):
            return rig
        found = rig_of(self.known.model)
        return Rig(found.cameras[:num], found.cam_from_rig[:num])


def read_known_map(folder: Path, options: Options, events: Events, above: tuple[Path, ...] = ()) -> ReadMap:
    """Read the largest map of a run, or a COLMAP model, with its pictures.

    Args:
        folder: OUT of ``odometry`` or ``reconstruct``, or the folder of a COLMAP model with its photographs.
        options: of the run that is to be localised; masks and limits of photographs count here.
        above: maps that were made in this one, from whose reading this is called.

    Raises:
        InputError, UsageError: it is none of these, its frames or photographs are gone, or it contradicts itself.
        NoReconstructionError: it holds no map.
    """
    events.started(STAGE, f"reading the map in {folder}")
    if (folder / MANIFEST).is_file() and read_manifest(folder).command == ODOMETRY:
        found = _of_odometry(folder, options, events, (*above, folder.resolve()))
    else:
        found = ReadMap(_of_photographs(folder, options, events))
    known = found.known
    check_observations(known)
    events.finished(STAGE, f"{len(known.image_idx)} keyframes, {len(known.pictures)} of them with a picture")
    return found


def check_observations(known: KnownMap) -> None:
    """Refuse a map whose points are not where its own images show them: whatever is found by them is wrong.

    Raises:
        InputError: half of the observations are farther off than an inlier of a localised image may be.
    """
    model = known.model
    chosen = np.flatnonzero(model.obs_is_inlier)
    if not len(chosen):
        return
    # what lies behind its camera has no residual
    off = np.nan_to_num(model.errors_px()[chosen], nan=np.inf)
    image = model.tracks.obs_image_idx[chosen]
    limit = RelocalizeOptions().error_px(model.cameras[model.image_camera_idx[image[0]]])
    middle = float(np.median(off))
    if middle <= limit:
        return
    images = np.unique(image)
    worst = int(images[np.argmax([np.median(off[image == k]) for k in images])])
    raise InputError(
        f"{known.source}: expected the points of the map where its own images show them, to {limit:.1f} px, found half "
        f"of the observations more than {middle:.1f} px off, those of {model.image_names[worst]} most",
        "its points, poses and cameras are not of one adjustment: map it again",
    )


def _of_odometry(folder: Path, options: Options, events: Events, above: tuple[Path, ...]) -> ReadMap:
    manifest, odometry = read_manifest(folder, ODOMETRY), read_odometry(folder)
    if not odometry.maps:
        raise NoReconstructionError(f"{folder} holds no map", "run sfmapp odometry again")
    entry = odometry.maps[0]
    model = entry.reconstruction
    wanted = options_from_dict({"sequence": manifest.options.get("sequence", {})}).sequence
    sequence = open_sequence(manifest.source, wanted, events)
    names = {
        int(frame): model.image_names[image]
        for frame, image in zip(entry.keyframe_frame_idx, entry.keyframe_image_idx, strict=True)
    }
    pictures = {}
    with SequenceSource(sequence, names) as source:
        for image in entry.keyframe_image_idx.tolist():
            events.raise_if_cancelled()
            pictures[image] = as_gray(source.pixels(model.image_names[image]))
    earlier = options_from_dict({"odometry": manifest.options.get("odometry", {})}).odometry.known_map
    if earlier is not None:
        if Path(earlier).resolve() in above:
            raise InputError(f"{folder} and {earlier} say that each was made in the other", "run one of them again")
        before = _read_earlier(Path(earlier), options, events, above)
        pictures |= {} if before is None else _pictures_of(before, model)
    known = KnownMap(str(folder), model, _by_rig(model), pictures, entry.scale_source, entry.scale_sigma)
    return ReadMap(known, sequence.rig)


def _read_earlier(folder: Path, options: Options, events: Events, above: tuple[Path, ...]) -> KnownMap | None:
    """The map that another one was made in; None if it is gone."""
    try:
        return read_known_map(folder, options, events, above).known
    except InputError as error:
        events.warned(STAGE, f"what a part of the map looks like is not known: {error}")
        return None


def _pictures_of(before: KnownMap, model: Reconstruction) -> dict[int, NDArray[np.uint8]]:
    """Pictures of the images that a map has of the one that it was made in, by image."""
    image_of = {name: image for image, name in enumerate(model.image_names) if name.startswith(PREFIX)}
    found = {}
    for image, picture in before.pictures.items():
        here = image_of.get(PREFIX + before.model.image_names[image])
        if here is not None:
            given = before.model.cameras[before.model.image_camera_idx[image]]
            found[here] = as_seen_by(picture, given, model.cameras[model.image_camera_idx[here]])
    return found


def _of_photographs(folder: Path, options: Options, events: Events) -> KnownMap:
    where, images, is_upright = _model_and_photographs(folder)
    model, _ = read_model(where)
    found = find_photographs(
        model, images, options.images, is_upright=is_upright, threads=options.num_workers, events=events
    )
    # pixels of the photographs as they are held, which may be copies of another size
    pictures = {int(image): read_gray(record) for image, record in zip(found.image_idx, found.records, strict=True)}
    sigma = metre_sigma_of_run(folder)
    alone = np.arange(len(model.image_names), dtype=np.int64)[:, None]
    return KnownMap(str(folder), replace(model, rig=None), alone, pictures, "none" if sigma is None else "map", sigma)


def _model_and_photographs(folder: Path) -> tuple[Path, Path, bool]:
    """The folders of a model and of its photographs, and whether it counts in photographs turned as EXIF says."""
    if (folder / MANIFEST).is_file():
        manifest, model = read_manifest(folder, RECONSTRUCT), folder / "sparse" / "0"
        if not has_model(model):
            raise NoReconstructionError(f"{folder} holds no model", "run sfmapp reconstruct again")
        root = image_root(manifest)
        if root is None:
            raise missing_photographs(folder, manifest)
        return model, root, not has_stored_pixels(manifest)
    model = folder if has_model(folder) else folder / "sparse" / "0"
    if not has_model(model):
        raise InputError(
            f"{folder}: expected the OUT of sfmapp odometry or reconstruct, or a COLMAP model, found none of them"
        )
    images = next((model / name for name in USUAL_FOLDERS if (model / name).is_dir()), None)
    if images is None:
        looked = ", ".join(os.path.normpath(model / name) for name in USUAL_FOLDERS)
        raise InputError(f"{model}: expected its photographs in {looked}, found no such folder", "put them there")
    return model, images, False


def _by_rig(model: Reconstruction) -> NDArray[np.int64]:
    """(K, S) images by frame of the rig and camera."""
    if model.rig is None:
        return np.arange(len(model.image_names), dtype=np.int64)[:, None]
    table = np.full((int(model.rig.frame_idx.max()) + 1, len(model.rig.cam_from_rig)), -1, np.int64)
    on_rig = np.flatnonzero(model.rig.frame_idx >= 0)
    table[model.rig.frame_idx[on_rig], model.rig.sensor_idx[on_rig]] = on_rig
    return table[(table >= 0).all(1)]
