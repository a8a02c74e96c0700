"""One call: photographs or video to a reconstruction, a trajectory, patches, a mesh, and what is done with them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from collections.abc import Sequence as Rows
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from sfmapp.adjust.linear import one_blas_thread
from sfmapp.api.images import load_images
from sfmapp.api.reconstruction import Reconstruction
from sfmapp.api.stages import extract_features, map_images, match_images
from sfmapp.errors import UsageError
from sfmapp.events import Event, Events, Listener
from sfmapp.images.load import GivenImages, Images
from sfmapp.workspace.options import Options

if TYPE_CHECKING:
    from sfmapp.evaluation.second_opinion import SecondOpinionOptions
    from sfmapp.images.sequence import Sequence
    from sfmapp.odometry.result import OdometryResult
    from sfmapp.odometry.snapshot import FrameSnapshot
    from sfmapp.panorama.canvas import Projection
    from sfmapp.pipelines.dense.densify import DenseResult
    from sfmapp.pipelines.dense.mesh import MeshResult
    from sfmapp.pipelines.evaluate import EvaluateOptions, Evaluation
    from sfmapp.pipelines.panorama import PanoramaResult
    from sfmapp.pipelines.sparse.locate import LocatedResult
    from sfmapp.pipelines.undistort import UndistortResult
    from sfmapp.report.model import ExportReport, OdometryRunReport, ReconstructionReport, RefineReport
    from sfmapp.report.plan import PlanReport
    from sfmapp.report.validation import Validation

FilePath = str | os.PathLike[str]


class RunResult(NamedTuple):
    """What ``reconstruct`` found.

    Attributes:
        reconstruction: the largest model, with views of its images and points.
        report: what is in ``report.json``; None where nothing was written.
    """

    reconstruction: Reconstruction
    report: ReconstructionReport | None


class TrackResult(NamedTuple):
    """What ``track_sequence`` or ``refine`` found.

    Attributes:
        odometry: the trajectory over all frames, and the keyframe maps, the largest first: ``cam_from_world`` (F, 7),
            NaN in gaps, ``timestamps_s`` (F,), ``maps[0].reconstruction``.
        report: what is in ``report.json``; None where nothing was written.
    """

    odometry: OdometryResult
    report: OdometryRunReport | RefineReport | None


def reconstruct(
    images: GivenImages,
    output: FilePath | None = None,
    options: Options | None = None,
    *,
    add: bool = False,
    record: bool = True,
    events: Events | None = None,
    threads: int | None = None,
    seed: int | None = None,
) -> RunResult:
    """Reconstruct cameras and points from photographs.

    With an output folder, what an earlier run in it has done is used where it still holds.

    Args:
        images: whatever ``load_images`` takes: a folder, a glob pattern or a ``.txt`` list of files; arrays by name; an
            :class:`ImageSource`; an :class:`ImageSet`. With an output folder also a video, of which frames are chosen,
            and several of these in a list. No pixels are kept of those that are no files: what looks at them again
            (``densify``, ``undistort``, ``validate``) wants them as files, and says so.
        output: folder of the results: new, empty, or of an earlier run. None: nothing is written.
        options: of all stages; see ``load_options``.
        add: the photographs, which are files, are added to the finished reconstruction in the output folder, with its
            options; it is as it was until that is done.
        record: write ``recording.rrd``, which replays the run.
        events: told of everything that happens, and can ask the run to stop.
        threads: workers; None: as ``options.threads`` says, or as many as there are cores.
        seed: in place of ``options.seed``. The same seed gives the same bytes, for any number of threads.

    Returns:
        The largest model (as it is read back from ``sparse/0``, if it was written), and the report.

    Raises:
        UsageError: the output folder holds something else, or another run is at work in it; photographs in memory, or
            options that differ, are to be added.
        InputError: the photographs do not exist or cannot be read.
        NoReconstructionError: they hold no reconstruction; the report is written.
        TooFewImagesError: fewer images than ``options.min_registered``; everything is written.
        InterruptedRunError: ``events`` was asked to stop; the same call resumes.

    Example:
        >>> reconstruction, report = sfmapp.reconstruct("photos/", "out/")
        >>> reconstruction, report = sfmapp.reconstruct("walk.mp4", "out/")
        >>> reconstruction, report = sfmapp.reconstruct("more/", "out/", add=True)
        >>> reconstruction.points.xyz, reconstruction.image("a.jpg").cam_from_world
    """
    if add:
        from sfmapp.pipelines.sparse.add import add_photographs

        if output is None or not isinstance(images, str | os.PathLike | list | tuple):
            raise UsageError("photographs are added as files, to the reconstruction in an output folder")
        asked = options if options is None and threads is None else options_with(options, threads, seed)
        found, report = add_photographs(images, output, asked, events=events, record=record)
        return RunResult(Reconstruction.of(found), report)
    from sfmapp.pipelines.sparse.videos import Sources, sources_of

    options = options_with(options, threads, seed)
    if output is not None:
        from sfmapp.pipelines.sparse import reconstruct as pipeline

        found, report = pipeline.reconstruct(images, output, options, events=events, record=record)
        return RunResult(Reconstruction.of(found), report)
    given = sources_of(images)
    if isinstance(given, Sources):
        raise UsageError("frames of videos, and photographs from several places, need an output folder to be kept in")
    workers, seed_used = options.num_workers, options.seed
    image_set = load_images(given, options.images, events=events, threads=threads)
    features = extract_features(image_set, options.features, events=events, threads=workers)
    correspondences = match_images(
        image_set, features, options.pairs, options.matching, events=events, threads=workers, seed=seed_used
    )
    models = map_images(
        image_set, features, correspondences, options.mapping,
        adjust_options=options.adjust, events=events, threads=workers,
    )  # fmt: skip
    return RunResult(models[0], None)


def plan(
    images: Images,
    options: Options | None = None,
    *,
    dense: bool = False,
    mesh: bool = False,
    events: Events | None = None,
    threads: int | None = None,
    seed: int | None = None,
) -> PlanReport:
    """Tell what :func:`reconstruct` will take, and what will probably go wrong, before it begins.

    Photographs are looked at in small, a few are worked on as the run will do it, and the machine is measured once, by
    the bundled sample. The plan is remembered for this user: a run with the same photographs and options compares
    itself with it, in ``report.plan``.

    Args:
        images: as ``reconstruct`` takes them.
        options: of all stages; see ``load_options``.
        dense, mesh: tell as well, roughly, what patches and a mesh of them will take.
        events: told of everything that happens, and can ask it to stop.
        threads: workers of the run; None: as ``options.threads`` says, or as many as there are cores.
        seed: in place of ``options.seed``.

    Returns:
        Cameras, groups, pairs, CPU and wall seconds and memory (1e6 bytes) of each stage as intervals that hold nine in
        ten, disk, and ``doubts``, each with photographs, what was found, and a remedy.

    Raises:
        UsageError: it is a video, whose frames are not chosen yet.
        InputError: the photographs do not exist or cannot be read.
        NoReconstructionError: fewer than two can be used.
        InterruptedRunError: a stop was asked for.

    Example:
        >>> planned = sfmapp.plan("photos/")
        >>> planned.whole.wall_s.likely, [doubt.message for doubt in planned.doubts]
    """
    from sfmapp.pipelines.planning import plan as pipeline

    return pipeline.plan(images, options_with(options, threads, seed), dense=dense, mesh=mesh, events=events)


def track_sequence(
    source: FilePath | Sequence,
    output: FilePath | None = None,
    options: Options | None = None,
    *,
    self_calibrate: bool = False,
    known_map: FilePath | None = None,
    record: bool = True,
    on_frame: Callable[[FrameSnapshot], None] | None = None,
    events: Events | None = None,
    threads: int | None = None,
    seed: int | None = None,
) -> TrackResult:
    """Track a camera, or a stereo rig, through a sequence.

    Args:
        source: a folder of frames, a video file or stream, a bag of ROS 1 or 2, an MCAP file, or the folder of a KITTI,
            TUM or EuRoC sequence; or frames in memory, :class:`ArraySequence`, or whatever has the members of one.
        output: folder of the results: new, empty, or of an earlier odometry run, whose results are replaced. None, for
            frames in memory alone: nothing is written.
        options: of these, ``sequence``, ``odometry`` and ``scale``.
        self_calibrate: find the intrinsics by a reconstruction from the first minute.
        known_map: OUT of an earlier ``track_sequence`` or ``reconstruct``, or a COLMAP model with its photographs: what
            the sequence sees of it is localised there, in its frame and unit of length, and the rest is mapped anew.
        record: write ``recording.rrd``, which replays the run.
        on_frame: called with each frame as soon as its pose is known, in the thread that tracks: ``cam_from_world``
            (7,), NaN without a pose, ``state``, ``xy`` (N, 2) tracked pixels.
        events: told of everything that happens, and can ask the run to stop: what was tracked until then is written.
        threads: workers; None: as ``options.threads`` says, or as many as there are cores.
        seed: in place of ``options.seed``. The same seed gives the same bytes, for any number of threads.

    Returns:
        Poses of all frames in the world of their map (that of its first camera), maps, and the report.

    Raises:
        UsageError: the output folder holds something else, or another run is at work in it, or there is none and the
            frames are not in memory.
        InputError: the sequence does not exist or cannot be read, or its camera is not known.
        NoReconstructionError: no map could be made; the report is written.
        InterruptedRunError: ``events`` was asked to stop.

    Example:
        >>> frames = sfmapp.ArraySequence(grab(), camera, fps=20)
        >>> sfmapp.track_sequence(frames, on_frame=lambda frame: steer(frame.cam_from_world))
    """
    options, events = options_with(options, threads, seed), events or Events()
    if known_map is not None:
        options = replace(options, odometry=replace(options.odometry, known_map=os.fspath(known_map)))
    with _told_of_frames(events, on_frame):
        if output is None:
            if options.odometry.known_map is not None:
                raise UsageError("a sequence in a known map needs a folder for its results", "give the second argument")
            return TrackResult(_tracked_in_memory(source, options, events), None)
        from sfmapp.pipelines.odometry import track

        found, report = track.track_sequence(
            source, output, options, events=events, record=record, self_calibrate=self_calibrate
        )
        return TrackResult(_with_views(found), report)


def refine(
    output: FilePath,
    refined: FilePath | None = None,
    options: Options | None = None,
    *,
    photos: FilePath | None = None,
    free_intrinsics: bool = False,
    events: Events | None = None,
    threads: int | None = None,
    seed: int | None = None,
) -> TrackResult:
    """Adjust the maps of an odometry run globally, reject outliers, and move all frames along with their keyframes.

    Args:
        output: workspace of an odometry run; it is not changed.
        refined: folder of the results; None: ``refined`` in that workspace.
        options: of these, ``mapping`` and ``adjust``, and with photographs ``images``, ``features`` and ``matching``.
        photos: photographs to add to the largest map: a folder, a glob pattern or a list.
        free_intrinsics: refine the calibration of the sequence as well.
        events: told of everything that happens, and can ask the run to stop.
        threads: workers; None: as ``options.threads`` says, or as many as there are cores.
        seed: in place of ``options.seed``.

    Returns:
        The refined trajectory and maps, and the report.

    Raises:
        UsageError: ``refined`` holds something else.
        InputError: ``output`` is no workspace, or the photographs or, with them, the sequence cannot be read.
        NoReconstructionError: there is no map in it.
        InterruptedRunError: ``events`` was asked to stop.

    Example:
        >>> sfmapp.refine("track/", photos="photos/").odometry.maps[0].reconstruction
    """
    from sfmapp.pipelines.odometry import refine as pipeline

    found, report = pipeline.refine(
        output,
        refined,
        options_with(options, threads, seed),
        photos=photos,
        free_intrinsics=free_intrinsics,
        events=events,
    )
    return TrackResult(_with_views(found), report)


def locate_photographs(
    photographs: FilePath | Rows[FilePath],
    model: FilePath,
    output: FilePath | None = None,
    *,
    camera: str | None = None,
    events: Events | None = None,
) -> LocatedResult:
    """Find where photographs were taken in a finished reconstruction, which stays as it is.

    Args:
        photographs: a file, several, a folder or a glob pattern.
        model: the folder of a reconstruction.
        output: a new folder, an empty one, or that of an earlier call, for report and poses; None: nothing is written.
        camera: of the photographs, as ``images.camera``, where it is none of the model's. None: the model's, where EXIF
            or the size says so, or else as EXIF says, or searched.
        events: told of progress and warnings, and can ask to stop.

    Returns:
        ``photographs``, one for each: ``cam_from_world`` (7,) in the model's world, ``covariance`` (6, 6) over rotation
        in radians and translation, ``center_covariance`` (3, 3), the points that agree; or ``reason``, where it is not
        located. ``report`` has the same in plain values, with the seconds that each took.

    Raises:
        UsageError: an output that holds something else.
        InputError: there is no photograph, or the folder holds no reconstruction with its features.
        NoReconstructionError: it holds no model.
        InterruptedRunError: ``events`` was asked to stop.

    Example:
        >>> sfmapp.locate_photographs("new.jpg", "out/").photographs[0].cam_from_world
    """
    from sfmapp.pipelines.sparse.locate import locate_photographs as pipeline

    return pipeline(photographs, model, output, camera=camera, events=events)


def merge(
    first: FilePath, second: FilePath, output: FilePath, *, record: bool = True, events: Events | None = None
) -> RunResult:
    """Make one reconstruction of two that share photographs, or see the same place. Neither of them is changed.

    Args:
        first, second: their folders. Options, and what places the model in the world, are those of the first.
        output: a new folder, an empty one, or that of an earlier call.
        record: write ``recording.rrd``, which replays the run.
        events: told of everything that happens, and can ask the run to stop.

    Returns:
        The largest model as it is read back from ``sparse/0``, and the report, whose ``merged`` says how far apart the
        two were.

    Raises:
        UsageError: the output holds something else.
        InputError: one of them is no finished reconstruction, or its photographs are gone or have changed.
        NoReconstructionError: they do not agree, or have nothing in common.
        InterruptedRunError: ``events`` was asked to stop; the same call goes on.

    Example:
        >>> reconstruction, report = sfmapp.merge("monday/", "tuesday/", "both/")
    """
    from sfmapp.pipelines.sparse.merge import merge_reconstructions

    found, report = merge_reconstructions(first, second, output, events=events, record=record)
    return RunResult(Reconstruction.of(found), report)


def densify(
    source: FilePath,
    output: FilePath | None = None,
    options: Options | None = None,
    *,
    images: FilePath | None = None,
    maps: bool = False,
    record: bool = True,
    events: Events | None = None,
    threads: int | None = None,
) -> DenseResult:
    """Reconstruct a dense cloud of oriented patches from a model and its photographs.

    What an earlier run in the same workspace has done is used where it still holds.

    Args:
        source: a workspace of ``reconstruct``, or the folder of a COLMAP model.
        output: workspace of the results; None: ``source`` itself, or the folder ``sfmapp`` of a COLMAP model.
        options: of these, ``dense`` and, for masks, ``images``; ``images.camera`` is a calibration in place of the
            cameras of the model, whose poses and points are adjusted to it.
        images: folder of the photographs; None: as noted in the workspace, or where COLMAP has them.
        maps: write depth and normals of each view as well.
        record: write ``dense/recording.rrd``.
        events: told of everything that happens, and can ask the run to stop.
        threads: workers; None: as ``options.threads`` says, or as many as there are cores.

    Returns:
        ``patches`` with xyz (N, 3) in the world, normal (N, 3), rgb (N, 3) and more, the names of the images that they
        count, and the report.

    Raises:
        UsageError: a workspace of another command.
        InputError: no model, or too few of its photographs are there.
        NoReconstructionError: too few patches were found; they and the report are written.
        InterruptedRunError: ``events`` was asked to stop; the same call resumes.

    Example:
        >>> sfmapp.densify("out/").patches.xyz
    """
    from sfmapp.pipelines.dense.densify import dense

    return dense(source, output, options_with(options, threads), images=images, maps=maps, record=record, events=events)


def make_mesh(
    source: FilePath,
    output: FilePath | None = None,
    options: Options | None = None,
    *,
    record: bool = True,
    events: Events | None = None,
    threads: int | None = None,
) -> MeshResult:
    """Make a mesh of patches or of a cloud of oriented points: ``mesh/mesh.ply`` and ``mesh/mesh.glb``.

    Args:
        source: a workspace in which ``densify`` has been at work, or a PLY of points with normals.
        output: folder of the results of a PLY. A workspace takes its own: None.
        options: of these, ``surface``.
        record: show the mesh in ``dense/recording.rrd``.
        events: told of everything that happens, and can ask the run to stop.
        threads: workers; None: as ``options.threads`` says, or as many as there are cores.

    Returns:
        ``mesh`` with vertices (V, 3), faces (F, 3) and colours, None where that of an earlier run holds; the report.

    Raises:
        UsageError: a folder for the mesh of a workspace, none for that of a PLY, or a texture without photographs.
        InputError: no patches, not such a file, or the photographs are gone.
        NoReconstructionError: they hold no surface; the report is written.
        InterruptedRunError: ``events`` was asked to stop.

    Example:
        >>> sfmapp.make_mesh("out/", options=sfmapp.load_options(settings=["surface.texture=true"]))
    """
    from sfmapp.pipelines.dense.mesh import mesh_cloud, mesh_workspace

    options = options_with(options, threads)
    if Path(source).is_dir():
        if output is not None:
            raise UsageError(f"the mesh of {source} is written into it", "leave the output folder out")
        return mesh_workspace(source, options, record=record, events=events)
    if output is None:
        raise UsageError(f"expected a folder to write the mesh of {source} to, found none", "name one")
    return mesh_cloud(source, output, options, events=events)


def validate(
    output: FilePath,
    ground_truth: FilePath | None = None,
    *,
    options: SecondOpinionOptions | None = None,
    events: Events | None = None,
) -> Validation:
    """Compare a reconstruction with pycolmap's on the same photographs, and both with a ground truth.

    pycolmap's result is kept in the workspace and used again while photographs and options are the same.

    Args:
        output: the workspace of a run.
        ground_truth: COLMAP model, ``cameras.json`` or TUM trajectory; None: no ground truth.
        options: of pycolmap; None: its defaults, with what the user said of the cameras of our run.
        events: told of progress, and can ask to stop.

    Returns:
        Both results side by side, as numbers and as a ``table()``.

    Raises:
        InputError: no workspace, no ground truth, or the photographs are gone.
        NoReconstructionError: the workspace holds no model.
        InterruptedRunError: ``events`` was asked to stop.

    Example:
        >>> print(sfmapp.validate("out/").table())
    """
    from sfmapp.pipelines import validate as pipeline

    return pipeline.validate(output, ground_truth, options=options, events=events)


def evaluate(
    estimate: FilePath,
    ground_truth: FilePath,
    options: EvaluateOptions | None = None,
    *,
    times: FilePath | None = None,
) -> Evaluation:
    """Compare a trajectory with the ground truth: absolute (ATE) and relative errors (RPE), and KITTI's drift.

    Args:
        estimate: trajectory of TUM, KITTI or EuRoC, or the folder of an odometry run.
        ground_truth: a trajectory of these formats, not necessarily the same one, or the folder of a sequence.
        options: alignments, intervals and time offset.
        times: file with the seconds of the lines of KITTI trajectories.

    Returns:
        Errors in metres and degrees for each alignment, and a ``table()``.

    Raises:
        InputError: a file cannot be read, the two have no poses in common, or they do not determine an alignment.
        UsageError: an option that cannot be obeyed.

    Example:
        >>> print(sfmapp.evaluate("track/", "groundtruth.txt").table())
    """
    from sfmapp.pipelines import evaluate as pipeline

    return pipeline.evaluate(estimate, ground_truth, options, times=times)


def stitch_panorama(
    images: Images,
    output: FilePath,
    options: Options | None = None,
    *,
    projection: Projection | None = None,
    max_size: int | None = None,
    picture: str = "panorama.jpg",
    events: Events | None = None,
    threads: int | None = None,
) -> PanoramaResult:
    """Stitch photographs, or a video, that were taken turning on the spot. The same call again resumes one that was cut
    off.

    Args:
        images: as of :func:`reconstruct`, or a video, of which sharp frames are picked.
        output: a new folder, an empty one, or that of an earlier call: the picture, ``rotations.json``, the cameras as
            a COLMAP model without points, and the report.
        options: of these, those of images, features (of each photograph 1,200 at most), pairs, matching and seed.
        projection: ``spherical``, ``cylindrical`` or ``planar``; None: as the field of view asks for.
        max_size: limit of the longer side of the picture, pixels; None: none but that of JPEG.
        picture: name of its file, which ends in .jpg, .png or .tif.
        events: told of progress, and can ask to stop.
        threads: photographs worked on at a time; None: as ``options.threads`` says, or one for each core.

    Returns:
        The folder, the picture, and the report: ``report.turning.images`` with the rotations (quaternions x, y, z, w of
        cam_from_world) and their sigmas in degrees, ``report.turning.cameras`` with the lens.

    Raises:
        UsageError: a projection, size or kind of picture that is none, or an output that holds something else.
        InputError: no photographs, or none that can be read.
        NoReconstructionError: the camera did not turn on the spot, or nothing overlaps; the report is written.
        InterruptedRunError: ``events`` was asked to stop.

    Example:
        >>> result = sfmapp.stitch_panorama("photos/", "pano/", projection="spherical")
        >>> result.picture, result.report.turning.cameras[0].focal_px
    """
    from sfmapp.pipelines import panorama as pipeline

    layout = pipeline.PictureLayout(picture, projection, max_size)
    return pipeline.stitch_panorama(images, output, options_with(options, threads), layout=layout, events=events)


def undistort(
    source: FilePath,
    output: FilePath,
    options: Options | None = None,
    *,
    images: FilePath | None = None,
    blank_pixels: float = 0.0,
    max_size: int | None = None,
    front_only: bool = False,
    events: Events | None = None,
    threads: int | None = None,
) -> UndistortResult:
    """Write undistorted photographs of a model, and the model with PINHOLE cameras beside them.

    A photograph that shows more than 88 degrees from the axis of its lens, a panorama for example, becomes the faces of
    a cube that it shows some of, mounted together as a rig. The same call again resumes one that was cut off.

    Args:
        source: the workspace of a reconstruction or of odometry on a folder of frames, or the folder of a COLMAP model;
            with a calibration also photographs alone: a folder, a glob or a list.
        output: a new folder, an empty one, or that of an earlier call.
        options: of these, the masks (``images.mask_path``), and ``images.camera``: a calibration in place of the
            cameras of the model, whose poses and points are adjusted to it.
        images: folder of the photographs; None: as noted in the workspace, or where COLMAP has them.
        blank_pixels: from 0 for pictures without a blank pixel to 1 for all that the photographs show.
        max_size: largest side of the pictures in pixels; None for no limit.
        front_only: of such photographs one picture of what lies in front, in place of the faces.
        events: told of progress, and can ask to stop.
        threads: photographs worked on at a time; None: as ``options.threads`` says, or one for each core.

    Returns:
        The folder, and the report of what is in it.

    Raises:
        UsageError: a share or size that makes no sense, or an output that holds something else.
        InputError: no model, none of its photographs, or two pictures of the same name.
        NoReconstructionError: the workspace holds no model.
        InterruptedRunError: ``events`` was asked to stop.

    Example:
        >>> sfmapp.undistort("out/", "splat/")  # for trainers of Gaussian splats
        >>> sfmapp.undistort("photos/", "straight/", sfmapp.load_options(settings=["images.camera=cam/"]))
    """
    from sfmapp.pipelines import undistort as pipeline
    from sfmapp.scene.undistortion import Layout

    layout = Layout(blank_pixels, max_size, front_only)
    return pipeline.undistort(
        source, output, options_with(options, threads), images=images, layout=layout, events=events
    )


def export(
    source: FilePath | Reconstruction,
    target: str,
    path: FilePath,
    *,
    images: FilePath | None = None,
    crs: str | None = None,
    is_dense: bool = False,
) -> ExportReport:
    """Write a model in another program's format, read it back, and compare every reprojection.

    Args:
        source: the workspace of a run, of which the largest model is taken, the folder of a COLMAP model, or a
            reconstruction in memory.
        target: ``colmap-bin``, ``colmap-text``, ``ply``, ``las``, ``laz``, ``bundler``, ``nerfstudio``, and for maps of
            the photographs ``geojson`` or ``kml``.
        path: where to write: a folder for COLMAP's formats, a file or folder for the others.
        images: folder of the photographs, for formats that name them; None: as noted in the workspace, or where COLMAP
            has them.
        crs: coordinate system of the points of PLY, LAS and LAZ, in metres, such as ``EPSG:25833``; None: of PLY the
            frame of the model, of the others its UTM zone.
        is_dense: of PLY, LAS and LAZ: the dense points of the run, not the sparse ones.

    Returns:
        ``files`` that were written, the worst differences, and notes for whoever uses them.

    Raises:
        UsageError: an unknown format, a camera or name that it cannot hold, the model's own folder as the target, or a
            coordinate system or dense points that the format or the model has no place for.
        NoReconstructionError: the workspace holds no model.
        InputError: there is no model, nothing can be written, or what was read back is not what was written.

    Example:
        >>> sfmapp.export("out/", "nerfstudio", "nerf/")
        >>> sfmapp.export("out/", "laz", "site.laz", crs="EPSG:25833", is_dense=True)
    """
    from sfmapp.pipelines.export import export_model

    keypoints = source.keypoints if isinstance(source, Reconstruction) else None
    return export_model(source, target, path, images=images, keypoints=keypoints, crs=crs, is_dense=is_dense)


def options_with(options: Options | None, threads: int | None, seed: int | None = None) -> Options:
    """The options with what was given beside them."""
    options = options or Options()
    if threads is not None:
        options = replace(options, threads=threads)
    return options if seed is None else replace(options, seed=seed)


@contextmanager
def _told_of_frames(events: Events, on_frame: Callable[[FrameSnapshot], None] | None) -> Iterator[None]:
    """Let a function hear of each frame until the block ends: the events are the user's, and may see another call."""
    from sfmapp.odometry.snapshot import FrameSnapshot

    def listen(event: Event) -> None:
        snapshot = event.data.get("snapshot")
        if on_frame is not None and isinstance(snapshot, FrameSnapshot):
            on_frame(snapshot)

    events.subscribe(listen)
    try:
        yield
    finally:
        events.unsubscribe(listen)


def _tracked_in_memory(source: FilePath | Sequence, options: Options, events: Events) -> OdometryResult:
    from sfmapp.errors import NoReconstructionError
    from sfmapp.odometry.run import run_odometry
    from sfmapp.pipelines.odometry.filtering import filter_beside
    from sfmapp.pipelines.odometry.scale import parse_scale, resolve_scale_request, scale_maps, takes_imu

    if isinstance(source, str | os.PathLike):
        raise UsageError("a sequence of files needs a folder for its results", "give one as the second argument")
    wanted = options.scale.source
    request = resolve_scale_request(None if wanted is None else parse_scale(wanted), wanted is None, source)
    beside = filter_beside(source) if options.odometry.filter else None
    with one_blas_thread(), _listening(events, beside):
        found = run_odometry(
            source, options.odometry, seed=options.seed, threads=options.num_workers, events=events,
            markers=None if request is None else request.detector(), with_imu=takes_imu(request, wanted is None),
        )  # fmt: skip
    if request is not None:
        scale_maps(found, request, events)
    if not found.maps:
        raise NoReconstructionError(f"{len(found.frame_idx)} frames were given, but no map could be initialized")
    if beside is not None and (filtered := beside.finish(events)) is not None:
        found.filtered = filtered[0]
    return _with_views(found)


@contextmanager
def _listening(events: Events, listener: Listener | None) -> Iterator[None]:
    if listener is not None:
        events.subscribe(listener)
    try:
        yield
    finally:
        if listener is not None:
            events.unsubscribe(listener)


def _with_views(found: OdometryResult) -> OdometryResult:
    for entry in found.maps:
        entry.reconstruction = Reconstruction.of(entry.reconstruction)
    return found
