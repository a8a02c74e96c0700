"""A model of COLMAP's (or of anything that writes its format) adjusted anew and saved.

python examples/04_colmap_model.py colmap/sparse/0 refined/sparse/0
"""

import sys

import sfmapp


def main(source: str, target: str) -> None:
    model = sfmapp.load(source)
    first, last = model.images[0], model.images[-1]
    # the pose of the first image stays; a loss that lets go of outliers; principal points may move as well
    options = sfmapp.AdjustOptions(loss="huber", loss_scale_px=1.0, refine_principal_point=True)
    report = sfmapp.adjust_bundle(model, options, constant_images=[first.name])
    print(f"{report.termination}, {report.num_iterations} steps: {report.initial_cost:.1f} to {report.final_cost:.1f}")
    print(f"{last.name} is at {last.cam_from_world.center}, its camera is {last.camera.params}")
    model.save(target)


if __name__ == "__main__":
    main(*sys.argv[1:])
