"""Agisoft Metashape's project of cameras as XML (its manual, appendix C and D: the camera models and the exported cameras).

    x' = x (1 + K1 r² + K2 r⁴ + K3 r⁶ + K4 r⁸) + P1 (r² + 2 x²) + 2 P2 x y ,   y' = y (…) + P2 (r² + 2 y²) + 2 P1 x y
    u = w/2 + cx + x' f + x' B1 + y' B2 ,   v = h/2 + cy + y' f

so f = fy, B1 = b1 f, B2 = b2 f, P1 = p2, P2 = p1, cx = cx_ours + 1/2 − w/2: the one format with our affinity. A camera's transform is
16 numbers, camera → chunk, row by row; the chunk's own scale is 1 here (metres).
"""

from pathlib import Path
from xml.etree import ElementTree as Xml

import numpy as np

from ...foundation import bounded, store
from ...foundation.errors import InputError
from ...geometry.camera import Camera, camera_of, interior_of
from ...geometry.rig import Rig
from .reading import NO_UNIT, left_out, make_camera, numbers, text_of


def read(path: Path) -> Rig:
    """Read the cameras that have a transform.

    Raises:
        InputError: it is no XML of Metashape, or a camera is incomplete or of another model.
    """
    try:
        root = bounded.xml_of(text_of(path))
    except ValueError as error:
        raise InputError(f"{path} is not an XML file that can be read ({error}); export the cameras again.") from error
    sensors = {sensor.get("id"): sensor for sensor in root.iter("sensor")}
    scaled = root.findtext(".//chunk/transform/scale")
    scale = float(numbers((scaled or "1").split(), (1,), f"The chunk's scale in {path}")[0])
    cameras, unaligned = [], list[str]()
    for element in root.iter("camera"):
        transform = element.findtext("transform")
        if transform is None:
            unaligned.append(str(element.get("label") or element.get("id")))
            continue
        sensor = sensors.get(element.get("sensor_id"))
        if sensor is None:
            raise InputError(f"Camera “{element.get('label')}” in {path} names a sensor that the file lacks.")
        cameras.append(_camera(path, str(element.get("label") or element.get("id")), sensor, transform, scale))
    if not cameras:
        raise InputError(f"{path} has no aligned camera; align the cameras in Metashape and export them as Agisoft XML.")
    remarks = left_out(unaligned, "they are not aligned in Metashape")
    return Rig(cameras=tuple(cameras), metadata={} if scaled else {"scale": NO_UNIT}, remarks=remarks)


def _camera(path: Path, name: str, sensor: Xml.Element, transform: str, scale: float) -> Camera:
    adjusted = [c for c in sensor.findall("calibration") if c.get("class", "adjusted") == "adjusted"]
    calibration = adjusted[0] if adjusted else sensor.find("calibration")
    if calibration is None or (calibration.get("type") or "frame") != "frame":
        raise InputError(f"The sensor of camera “{name}” in {path} has no calibration of type “frame”.")
    resolution = calibration.find("resolution")
    resolution = sensor.find("resolution") if resolution is None else resolution
    if resolution is None:
        raise InputError(f"The sensor of camera “{name}” in {path} has no resolution.")
    what = f"Camera “{name}” in {path}"
    w, h = numbers([resolution.get("width"), resolution.get("height")], (2,), what)
    keys = ("f", "cx", "cy", "k1", "k2", "k3", "k4", "p1", "p2", "p3", "p4", "b1", "b2")
    p = dict(zip(keys, numbers([calibration.findtext(k) or "0" for k in keys], (len(keys),), what)))
    if used := [key for key in ("k4", "p3", "p4") if p[key]]:
        raise InputError(f"{what} uses {used[0]}; optimize the cameras in Metashape without it.")
    if p["f"] <= 0:
        raise InputError(f"{what} has no focal length.")
    interior = np.array([p["f"], p["cx"] + w / 2 - 0.5, p["cy"] + h / 2 - 0.5, *(p[k] for k in ("k1", "k2", "k3", "p2", "p1"))])
    interior = np.append(interior, [p["b1"] / p["f"], p["b2"] / p["f"]])
    T = numbers(transform.split(), (4, 4), f"The transform of {what}")
    R = T[:3, :3].T
    camera = camera_of(name, (int(w), int(h)), interior, np.eye(3), np.zeros(3))
    return make_camera(name, (w, h), camera.matrix, camera.distortions, R, -R @ T[:3, 3] * scale, camera.affinity)


def write(path: Path, rig: Rig) -> list[Path]:
    """Write sensors and cameras as Metashape exports them."""
    document = Xml.Element("document", version="2.0.0")
    chunk = Xml.SubElement(document, "chunk", label="Tricap", enabled="true")
    sensors, cameras = Xml.SubElement(chunk, "sensors"), Xml.SubElement(chunk, "cameras")
    for n, camera in enumerate(rig.cameras):
        sensor = Xml.SubElement(sensors, "sensor", id=str(n), label=camera.name, type="frame")
        size = dict(width=str(camera.size_px[0]), height=str(camera.size_px[1]))
        Xml.SubElement(sensor, "resolution", size)
        calibration = Xml.SubElement(sensor, "calibration", {"type": "frame", "class": "adjusted"})
        Xml.SubElement(calibration, "resolution", size)
        f, cx, cy, k1, k2, k3, p1, p2, b1, b2 = interior_of(camera).tolist()
        cx, cy = cx + 0.5 - camera.size_px[0] / 2, cy + 0.5 - camera.size_px[1] / 2
        for key, value in dict(f=f, cx=cx, cy=cy, b1=b1 * f, b2=b2 * f, k1=k1, k2=k2, k3=k3, p1=p2, p2=p1).items():
            Xml.SubElement(calibration, key).text = repr(value)
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = camera.R_cam_world.T, camera.centre_m
        element = Xml.SubElement(cameras, "camera", id=str(n), sensor_id=str(n), label=camera.name)
        Xml.SubElement(element, "transform").text = " ".join(repr(v) for v in T.ravel().tolist())
    Xml.indent(document)
    store.write_text(path, '<?xml version="1.0" encoding="UTF-8"?>\n' + Xml.tostring(document, encoding="unicode") + "\n")
    return [path]
