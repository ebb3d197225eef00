"""Wallis enhancement: the same local mean and contrast everywhere, for poor texture (Wallis 1976; D'Apuzzo et al. 2000, §2.2).

    g' = (g − m) c s_t / (c s + (1 − c) s_t) + b m_t + (1 − b) m                                          (1)

m, s are mean and standard deviation in a window around the pixel, m_t and s_t their target values, c and b the weights of the targets. In
an image of one field the window has half as many rows, so that it covers the same area. Where the contrast is only sensor noise, (1) would
only amplify that noise, so s is not taken below the noise: s ← max(s, NOISE_SIGMAS σ_n).

"auto" decides by the image: the noise from its second differences (Immerkær 1996, doi:10.1006/cviu.1996.0060), and the texture's energy per
noise energy of the gradients in the textured half of the image,

    ρ = median over the textured half of Σ|∇g|² / (n σ_∇²)                                                   (2)

how many times stronger the gradients are than those of noise alone.
"""

from dataclasses import dataclass

import cv2
import numpy as np

from ..foundation.settings import knob
from .sampling import noise_sigma

NOISE_SIGMAS = 2.0  # least s in (1), in sigmas of the noise
SMOOTHING_PX = 1.0  # of the gradients in (2)
WINDOW_PX = 21  # of the texture in (2)


@dataclass(frozen=True, kw_only=True, slots=True)
class EnhanceSettings:
    """Local contrast enhancement before matching."""

    wallis: str = knob(
        "off",
        "Local contrast enhancement: off, on, or auto (where the texture is weak compared with the noise of the image).",
        choices=("off", "auto", "on"),
    )
    window_px: int = knob(31, "Side of the window of local mean and contrast.", unit="px", low=5, high=201)
    mean: float = knob(127.0, "Target of the local mean grey value.", low=0.0, high=255.0)
    contrast: float = knob(55.0, "Target of the local standard deviation of the grey values.", low=1.0, high=120.0)
    contrast_share: float = knob(0.75, "Weight of that contrast against the image's own.", low=0.0, high=1.0)
    mean_share: float = knob(0.95, "Weight of that mean against the image's own.", low=0.0, high=1.0)
    weak_texture: float = knob(6.0, "Auto enhances images whose gradients are less than this many times those of noise.", low=0.0, high=1e4)


def wallis(image: np.ndarray, settings: EnhanceSettings, *, row_step: int = 1) -> np.ndarray:
    """The enhanced image (h, w) float32 of grey values (h, w).  (1)

    `row_step` is 2 for a field of an interlaced frame. Values are not clipped. Cost: about 8 ns per pixel, for any window.
    """
    g = np.asarray(image, dtype=np.float32)
    size = (settings.window_px | 1, max(3, round(settings.window_px / row_step)) | 1)
    centre = np.float32(g.mean())
    d = g - centre  # squares of small numbers are exact enough in single precision
    m = cv2.blur(d, size, borderType=cv2.BORDER_REFLECT_101)
    variance = cv2.sqrBoxFilter(d, cv2.CV_32F, size, borderType=cv2.BORDER_REFLECT_101) - m * m
    s = np.sqrt(np.maximum(variance, (NOISE_SIGMAS * noise_sigma(g)) ** 2))
    c, b, target = np.float32(settings.contrast_share), np.float32(settings.mean_share), np.float32(settings.contrast)
    gain = c * target / (c * s + (1 - c) * target)
    return (d - m) * gain + b * np.float32(settings.mean) + (1 - b) * (m + centre)


def without_shading(image: np.ndarray, window_px: int, *, row_step: int = 1) -> np.ndarray:
    """The image (h, w) float32 less its mean in a window around each pixel: light and shade, which stay in place while a body turns.

    `row_step` is 2 for a field of an interlaced frame. Cost: about 3 ns per pixel, for any window.
    """
    g = np.asarray(image, dtype=np.float32)
    return g - cv2.blur(g, (window_px | 1, max(3, round(window_px / row_step)) | 1), borderType=cv2.BORDER_REFLECT_101)


def texture_strength(image: np.ndarray, *, row_step: int = 1) -> float:
    """ρ of (2): the energy of the gradients as a multiple of what the noise gives them, in the textured half of the image."""
    g = np.asarray(image, dtype=np.float32)
    smooth = cv2.GaussianBlur(g, (0, 0), sigmaX=SMOOTHING_PX, sigmaY=max(0.5, SMOOTHING_PX / row_step))
    fx, fy = (cv2.Sobel(smooth, cv2.CV_32F, *axis, ksize=1, scale=0.5) for axis in ((1, 0), (0, 1)))
    local = cv2.blur(fx * fx + fy * fy, (WINDOW_PX, max(3, round(WINDOW_PX / row_step)) | 1))
    noise = noise_sigma(g) ** 2 * _gradient_gain(row_step)
    strong = local[local >= np.median(local)]
    return float(np.median(strong)) / noise


def enhanced(images: list[np.ndarray], settings: EnhanceSettings, *, row_step: int = 1) -> list[np.ndarray]:
    """The images of all views of one frame, enhanced by the settings: all or none, so that they remain similar.

    With "auto" all are enhanced if any of them has weak texture.
    """
    if settings.wallis == "auto":
        weak = min(texture_strength(image, row_step=row_step) for image in images) < settings.weak_texture
    else:
        weak = settings.wallis == "on"
    return [wallis(image, settings, row_step=row_step) for image in images] if weak else images


def _gradient_gain(row_step: int) -> float:
    """Energy of the smoothed image's gradients for white noise of variance 1."""
    impulse = np.zeros((33, 33), dtype=np.float32)
    impulse[16, 16] = 1.0
    smooth = cv2.GaussianBlur(impulse, (0, 0), sigmaX=SMOOTHING_PX, sigmaY=max(0.5, SMOOTHING_PX / row_step))
    return float(sum(np.sum(cv2.Sobel(smooth, cv2.CV_32F, *axis, ksize=1, scale=0.5) ** 2) for axis in ((1, 0), (0, 1))))
