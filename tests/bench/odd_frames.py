"""How well the texture of even frames shows the person in odd ones.

    .venv/py3.13/bin/python tests/bench/odd_frames.py TAKE OUT [--every 4]

OUT is a finished run of TAKE with a skin. The texture is made from even frames, as a run makes it from all; the skin of every so many odd
frames is rendered with it into the views. Printed are the PSNR and the median difference of grey values, times the views' exposures,
where the person of the footage (the background of the run's fit, in cells) and the skin overlap. Half a minute of CPU.
"""

import argparse
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from tricap.core.body.shape import read_body
from tricap.core.body.skin.closed_skin import OneSkin
from tricap.core.body.skin.fingers import shape_for_skin
from tricap.core.body.skin.mesh import SkinSettings
from tricap.core.body.skin.person_skin import REST, read_skin
from tricap.core.body.skin.posed import Poser
from tricap.core.body.skin.texture import MOST_FRAMES, Texture, TextureBaker, View
from tricap.core.fitting.inputs.background import find_background
from tricap.core.foundation.progress import Monitor
from tricap.core.geometry.camera import Camera
from tricap.core.geometry.raster import rasterize
from tricap.core.motion.formats.ply import read_ply
from tricap.core.motion.tables import read_motion
from tricap.core.take.footage import open_take
from tricap.core.take.take import read_take


def main() -> None:
    """See above."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("take", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--every", type=int, default=4, help="odd frames")
    chosen = parser.parse_args()
    footage = open_take(read_take(chosen.take))
    body, settings = read_body(chosen.out / "body.toml"), SkinSettings()
    motion = read_motion(chosen.out / "motion.csv", body.skeleton)
    person = shape_for_skin(body, settings)
    skin = read_skin(chosen.out / "skin" / REST, person)
    cameras, frames = footage.rig.cameras, motion.frames
    baker = TextureBaker(skin, person, settings.texture_px, len(cameras))
    even = np.flatnonzero(frames % 2 == 0)
    for row in even[np.unique(np.linspace(0, len(even) - 1, min(MOST_FRAMES, len(even))).round().astype(int))]:
        images = footage.read_colour(int(frames[row]))
        baker.add(motion.values[row], [View(camera=camera, rgb=rgb) for camera, rgb in zip(cameras, images)])
    texture, poser = baker.finished(), Poser(person, skin.weights)
    rows = np.flatnonzero(frames % 2 == 1)[:: chosen.every]
    clouds: list[Any] = [SimpleNamespace(frame=int(f), xyz_m=read_ply(chosen.out / "clouds" / f"{int(f):04d}.ply").xyz_m) for f in frames]
    regions = {region.view: region for region in find_background(footage, clouds, Monitor(), rows=rows.tolist())}
    off = []
    for row in rows:
        posed, images = poser.posed(skin.vertices_m, motion.values[row]), footage.read_colour(int(frames[row]))
        for k, (camera, rgb) in enumerate(zip(cameras, images)):
            shown, where = _rendered(camera, posed, skin, texture, k)
            beyond = regions[footage.take.views[k].name].of_frame(int(frames[row]))
            assert beyond is not None
            inside = cv2.resize((beyond == 0).astype(np.uint8), rgb.shape[1::-1], interpolation=cv2.INTER_NEAREST).ravel()[where] > 0
            grey = rgb.mean(axis=2).ravel()[where]
            off.append((shown - grey)[inside])
    difference = np.concatenate(off)
    print(f"PSNR {10 * np.log10(255**2 / np.mean(difference**2)):.2f} dB, median difference {np.median(np.abs(difference)):.1f}")


def _rendered(camera: Camera, posed: np.ndarray, skin: OneSkin, texture: Texture, view: int) -> tuple[np.ndarray, np.ndarray]:
    """Grey values (N,) of the skin in an image, and the flat indices (N,) of their pixels."""
    triangles = np.concatenate([skin.faces[:, [0, 1, 2]], skin.faces[:, [0, 2, 3]]])
    corners = np.concatenate([skin.uv[:, [0, 1, 2]], skin.uv[:, [0, 2, 3]]])
    raster = rasterize(camera, posed, triangles)
    weights = raster.pieces.weights(raster.piece, raster.xy_px)
    uv = np.einsum("nc,nck->nk", weights, corners[raster.triangle])
    size = len(texture.rgb)
    at = np.stack([uv[:, 0] * size - 0.5, (1 - uv[:, 1]) * size - 0.5], axis=1).astype(np.float32)
    grey = texture.rgb.mean(axis=2).astype(np.float32)
    found = [
        cv2.remap(grey, part, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).ravel() for part in np.array_split(at[:, None], 64)
    ]
    return np.concatenate(found) * texture.exposures[view], raster.sample


if __name__ == "__main__":
    main()
