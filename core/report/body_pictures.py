"""The fitted body over the footage of all views, in close-ups."""

from collections.abc import Sequence

import numpy as np

from ..body.motion import BodyFit
from ..geometry.rig import Rig
from . import pictures
from .close_up import alike, close_up
from .person import SkinAt
from .silhouettes import OUTLINE, PERSON, Silhouettes


class BodyPictures:
    """The pictures of a body in the frames `chosen` (indices of its motion), as close-ups (`near`) or whole images; none without
    a body or its skin."""

    def __init__(
        self, body: BodyFit | None, silhouettes: Silhouettes, skin_at: SkinAt | None, rig: Rig, chosen: Sequence[int], *, near: bool = True
    ) -> None:
        self._body, self._silhouettes = body, silhouettes
        self._skins = {i: skin_at(body.motion.values[i]) for i in chosen} if body and skin_at else {}
        places = [skin.vertices_m for skin in self._skins.values()] if near else []
        self._views = alike([close_up(camera, places) for camera in rig.cameras])

    def of_frame(self, index: int, images: Sequence[np.ndarray]) -> dict[str, tuple[str, np.ndarray]]:
        """File name → (caption, picture) of each view; `images` (h, w) are those of the frame."""
        body, found = self._body, dict[str, tuple[str, np.ndarray]]()
        if body is None or index not in self._skins:
            return found
        frame, skin = int(body.motion.frames[index]), self._skins[index]
        for image, view in zip(images, self._views):
            name, part = view.camera.name, view.around(skin.vertices_m)
            person = self._silhouettes.outlines.get(name, {}).get(frame)
            outline = None if person is None else part.pixels(person)
            picture = pictures.body_over_footage(part.image(image), part.camera, body.shape, body.motion.values[index], skin, outline)
            picture = pictures.with_scale(picture, part.camera, body.motion.joints_m[index])
            caption = f"Frame {frame}, view {name}: the fitted body{agreement_words(self._silhouettes, name, frame)}"
            found[f"body_{frame:04d}_{name}.png"] = (caption, picture)
        return found


def agreement_words(silhouettes: Silhouettes, view: str, frame: int) -> str:
    """The silhouette's part of a caption."""
    found = [f for f in silhouettes.fits if (f.view, f.frame) == (view, frame)]
    if not found:
        return ""
    fit, percent = found[0], 100 * found[0].overlap
    drawn = " (red)" if fit.person == OUTLINE else ""
    measure = "overlap (IoU) with" if silhouettes.whole else "share inside"
    return f" and its outline (green); {measure} {PERSON[fit.person]}{drawn}: {percent:.0f} %"
