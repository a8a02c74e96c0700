"""Draws a recording in a process of its own: ``python -m sfmapp.viewer.record_process``.

rerun takes half a second and a hundred megabytes to load; here they, and whatever may go wrong in it, stay away from
the run. When it is loaded a line is read that says what to draw: ``[KIND, FOLDER, OUTPUT, THREADS]`` as JSON.
"""

from __future__ import annotations

import gc
import json
import sys
from pathlib import Path


def main() -> None:
    """Load what takes long, and draw if there is something to draw in the end."""
    gc.disable()  # nothing that is loaded is ever rubbish
    import rerun  # noqa: F401

    if line := sys.stdin.readline():
        draw(*json.loads(line))
    gc.freeze()  # Python looks for some when it ends, even so


def draw(kind: str, folder: str, output: str, threads: int) -> None:
    """Draw what lies in folder: the replay of a run, a dense result, a calibration, a rig, a pair, and so on."""
    if kind == "dense":
        from sfmapp.viewer.dense_replay import DenseReplay
        from sfmapp.viewer.dense_rrd import write_dense_rrd

        write_dense_rrd(DenseReplay.load(Path(folder)), Path(output))
        return
    if kind == "calibration":
        from sfmapp.viewer.calibration_replay import CalibrationReplay
        from sfmapp.viewer.calibration_rrd import write_calibration_rrd

        write_calibration_rrd(CalibrationReplay.load(Path(folder)), Path(output))
        return
    if kind == "rig":
        from sfmapp.viewer.rig_replay import RigReplay
        from sfmapp.viewer.rig_rrd import write_rig_rrd

        write_rig_rrd(RigReplay.load(Path(folder)), Path(output))
        return
    if kind == "pair":
        from sfmapp.viewer.pair_replay import PairReplay
        from sfmapp.viewer.pair_rrd import write_pair_rrd

        write_pair_rrd(PairReplay.load(Path(folder)), Path(output))
        return
    if kind == "clouds":
        from sfmapp.viewer.uncalibrated_replay import CloudsReplay
        from sfmapp.viewer.uncalibrated_rrd import write_clouds_rrd

        write_clouds_rrd(CloudsReplay.load(Path(folder)), Path(output))
        return
    if kind == "transfer":
        from sfmapp.viewer.transfer_replay import TransferReplay
        from sfmapp.viewer.transfer_rrd import write_transfer_rrd

        write_transfer_rrd(TransferReplay.load(Path(folder)), Path(output))
        return
    if kind == "lines":
        from sfmapp.viewer.lines_replay import LinesReplay
        from sfmapp.viewer.lines_rrd import write_lines_rrd

        write_lines_rrd(LinesReplay.load(Path(folder)), Path(output))
        return
    if kind == "stereo":
        from sfmapp.viewer.stereo_replay import StereoReplay
        from sfmapp.viewer.stereo_rrd import write_stereo_rrd

        write_stereo_rrd(StereoReplay.load(Path(folder)), Path(output))
        return
    if kind == "carve":
        from sfmapp.viewer.carve_replay import CarveReplay
        from sfmapp.viewer.carve_rrd import write_carve_rrd

        write_carve_rrd(CarveReplay.load(Path(folder)), Path(output))
        return
    if kind == "sweep":
        from sfmapp.viewer.sweep_replay import SweepReplay
        from sfmapp.viewer.sweep_rrd import write_sweep_rrd

        write_sweep_rrd(SweepReplay.load(Path(folder)), Path(output))
        return
    from sfmapp.viewer.replay import Replay
    from sfmapp.viewer.rrd import write_rrd

    write_rrd(Replay.load(Path(folder)), Path(output), threads)


if __name__ == "__main__":
    main()
