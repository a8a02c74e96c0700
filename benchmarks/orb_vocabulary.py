"""A vocabulary for ORB-SLAM3 from photographs at hand, in the text format of DBoW2, where its own cannot be had.

    python benchmarks/orb_vocabulary.py OUT.txt FOLDER ...

Descriptors of OpenCV's ORB, clustered ten ways at each of six levels by their majority bits (Galvez-Lopez and Tardos,
"Bags of binary words", IEEE Transactions on Robotics 2012). Words only say which keyframes look alike, in
relocalisation, loops and the matching to a reference keyframe; what is tracked and adjusted does not hang on them.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

Bits = NDArray[np.float32]

BRANCHES, LEVELS, ROUNDS = 10, 6, 6
FEATURES, LONGEST_PX, MOST_DESCRIPTORS = 1500, 1000, 250_000
PICTURES = (".png", ".jpg", ".jpeg", ".ppm")


def describe(folders: list[Path]) -> tuple[NDArray[np.uint8], NDArray[np.int64]]:
    """Descriptors (N, 32) of all pictures in folders, and the picture of each."""
    orb, rows, owner = cv2.ORB_create(FEATURES), [], []
    pictures = sorted(p for folder in folders for p in folder.rglob("*") if p.suffix.lower() in PICTURES)
    for n, path in enumerate(pictures):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            continue
        scale = min(1.0, LONGEST_PX / max(image.shape))
        found = orb.detectAndCompute(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), None)[1]
        if found is not None:
            rows.append(found)
            owner.append(np.full(len(found), n, np.int64))
    return np.concatenate(rows), np.concatenate(owner)


def cluster(bits: Bits, rng: np.random.Generator) -> tuple[Bits, NDArray[np.int64]]:
    """Centres of descriptors (N, 256) of -1 and 1, and the centre of each; k-means++ and majorities."""
    if len(bits) <= BRANCHES:
        return bits, np.arange(len(bits))
    centers = bits[rng.integers(len(bits))][None]
    for _ in range(BRANCHES - 1):
        apart = np.maximum((256 - bits @ centers.T).min(1), 0.0) ** 2
        if not apart.sum() > 0:
            break
        centers = np.concatenate([centers, bits[rng.choice(len(bits), p=apart / apart.sum())][None]])
    for _ in range(ROUNDS):
        nearest = (bits @ centers.T).argmax(1)
        for k in np.unique(nearest):
            centers[k] = np.where(bits[nearest == k].sum(0) > 0, 1, -1)
    used, nearest = np.unique((bits @ centers.T).argmax(1), return_inverse=True)
    return centers[used], nearest


def vocabulary_lines(descriptors: NDArray[np.uint8], owner: NDArray[np.int64]) -> list[str]:
    """Lines of the file: parent, whether it is a word, 32 bytes, weight (inverse frequency among pictures)."""
    rng = np.random.default_rng(0)
    bits, num_pictures = np.unpackbits(descriptors, axis=1).astype(np.float32) * 2 - 1, len(np.unique(owner))
    lines, open_nodes = [f"{BRANCHES} {LEVELS} 0 0"], [(0, np.arange(len(bits)), 1)]
    while open_nodes:
        parent, mine, level = open_nodes.pop()
        centers, nearest = cluster(bits[mine], rng)
        for k, center in enumerate(centers):
            inside = mine[nearest == k]
            is_word = level == LEVELS or len(inside) <= 2
            weight = np.log(num_pictures / len(np.unique(owner[inside]))) if is_word else 0.0
            values = " ".join(str(value) for value in np.packbits(center > 0))
            lines.append(f"{parent} {int(is_word)} {values} {weight:.6g}")
            if not is_word:
                open_nodes.append((len(lines) - 1, inside, level + 1))
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("folders", type=Path, nargs="+")
    args = parser.parse_args()
    descriptors, owner = describe(args.folders)
    chosen = np.sort(np.random.default_rng(0).permutation(len(descriptors))[:MOST_DESCRIPTORS])
    lines = vocabulary_lines(descriptors[chosen], owner[chosen])
    args.out.write_text("\n".join(lines), encoding="utf-8")
    print(f"{args.out}: {len(lines) - 1} nodes of {len(chosen)} descriptors")


if __name__ == "__main__":
    main()
