"""A reconstruction without a folder of its own, handed to nerfstudio; stopped if it takes too long.

python examples/10_export_to_nerfstudio.py photos/ nerf/
"""

import sys
import threading

import sfmapp


def tell(event: sfmapp.Event) -> None:
    if event.kind == "finished":
        print(f"{event.time_s:6.1f} s  {event.stage}: {event.message}")


def main(photos: str, target: str) -> None:
    events = sfmapp.Events(tell)
    timer = threading.Timer(600, events.cancel)
    timer.start()
    try:
        reconstruction, _ = sfmapp.reconstruct(photos, events=events, seed=7)
    except sfmapp.SfmError as failure:  # its message names what was expected and found
        sys.exit(f"{failure}. {failure.advice or ''}")
    finally:
        timer.cancel()
    written = sfmapp.export(reconstruction, "nerfstudio", target, images=photos)
    print("\n".join(written["files"]))


if __name__ == "__main__":
    main(*sys.argv[1:])
